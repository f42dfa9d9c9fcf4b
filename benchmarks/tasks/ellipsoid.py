"""A rotated ellipsoid, 10⁶ times as curved along one axis as along another.

It is f10 of BBOB without the oscillation: what a second-order method is made for.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks._task import Budget, Task

TITLE = "Ellipsoid of condition number 1e6"
CONDITION = 1e6


def build(full: bool) -> list[Task]:
    """Quick: 5 dimensions; full: 5 and 10. Axes and reference are drawn once."""
    return [_task(n, full) for n in ((5, 10) if full else (5,))]


def _task(n: int, full: bool) -> Task:
    rng = np.random.default_rng(n)
    axes, _ = np.linalg.qr(rng.normal(size=(n, n)))
    reference = rng.uniform(-4, 4, n)
    stretched = np.sqrt(CONDITION) ** (np.arange(n) / (n - 1))

    def residuals(y: Float[Array, "n"]) -> Float[Array, "n"]:
        return jnp.asarray(stretched) * (jnp.asarray(axes) @ (y - reference))

    def loss(y: Float[Array, "n"]) -> Float[Array, ""]:
        return jnp.sum(residuals(y) ** 2)

    return Task(
        name=f"ellipsoid-{n}d",
        title=f"{TITLE} in {n}-D",
        loss=loss,
        exact_loss=loss,
        start=lambda seed: jax.random.uniform(jax.random.key(seed), (n,), minval=-4, maxval=4),
        reference=reference,
        bounds=(np.full(n, -5.0), np.full(n, 5.0)),
        sigma=1.0,
        budget=Budget(2000 * n, 60) if full else Budget(500 * n, 10),
        seeds=20 if full else 2,
        residuals=residuals,
        precision="float64",
        optimum=0.0,
    )
