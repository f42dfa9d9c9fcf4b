"""Quad: the papers' quadratic bowl in 2-D, 5x² + 5y² + 7.5xy. Six evaluations determine it."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from benchmarks._task import Budget, Task

TITLE = "Quad: a quadratic in 2-D"
REFERENCE = (0.4, -0.7)


def bowl(y: Float[Array, "2"]) -> Float[Array, ""]:
    """The quadratic, with its lowest value 0 at the reference."""
    d = y - jnp.asarray(REFERENCE, y.dtype)
    return 5 * d[0] ** 2 + 5 * d[1] ** 2 + 7.5 * d[0] * d[1]


def build(full: bool) -> Task:
    """Starts are within 3 of the reference."""
    reference = jnp.asarray(REFERENCE)

    def start(seed):
        return reference + jax.random.uniform(jax.random.key(seed), (2,), minval=-3, maxval=3)

    return Task(
        name="quad",
        title=TITLE,
        loss=bowl,
        exact_loss=bowl,
        start=start,
        reference=reference,
        bounds=(reference - 10, reference + 10),
        sigma=1.0,
        budget=Budget(2000, 30) if full else Budget(600, 10),
        seeds=20 if full else 5,
    )
