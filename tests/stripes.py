"""A task of the tests: two stripes whose brightness is sought, and a method that halves the way."""

import jax
import jax.numpy as jnp

from benchmarks._task import Budget, Task

TITLE = "Stripes"
SIDE = 8  # pixels


def build(full, spp=4):
    """A picture with one stripe of each parameter's brightness."""
    reference = jnp.asarray([0.25, 0.5])

    def image(y):
        return jnp.broadcast_to(jnp.repeat(y, SIDE // 2)[:, None, None], (SIDE, SIDE, 3))

    def residuals(y):
        return image(y) - image(reference)

    def loss(y):
        return jnp.sum(residuals(y) ** 2)  # exact, however it is compiled

    return Task(
        name="stripes",
        title=TITLE,
        loss=loss,
        exact_loss=loss,
        start=lambda seed: jnp.asarray([0.875, 0.125 + 0.0625 * (seed % 4)]),
        reference=reference,
        bounds=(jnp.zeros(2), jnp.ones(2)),
        sigma=0.3,
        budget=Budget(evaluations=60, seconds=60),
        seeds=2,
        image=image,
        residuals=residuals,
    )


def halving(task):
    """Halves the distance at each iteration, for one evaluation."""
    loss = jax.jit(task.loss)

    def solve(y0, key, record):
        y = y0
        for _ in range(8):
            y = (y + task.reference) / 2
            loss(y).block_until_ready()
            record(y)

    return solve
