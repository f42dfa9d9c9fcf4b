"""Rosenbrock's curved valley in 2, 10 and 30 dimensions, from the classical start."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks._task import Budget, Task

TITLE = "Rosenbrock's valley"


def residuals(y: Float[Array, "n"]) -> Float[Array, "m"]:
    """Those of which the function is the sum of squares."""
    return jnp.concatenate([10 * (y[1:] - y[:-1] ** 2), 1 - y[:-1]])


def valley(y: Float[Array, "n"]) -> Float[Array, ""]:
    """Rosenbrock's function; its lowest value is 0, where all are 1."""
    return jnp.sum(residuals(y) ** 2)


def build(full: bool) -> list[Task]:
    """Quick: 2 and 10 dimensions. All seeds start at (-1.2, 1, -1.2, ...)."""
    return [_task(n, full) for n in ((2, 10, 30) if full else (2, 10))]


def _task(n: int, full: bool) -> Task:
    return Task(
        name=f"rosenbrock-{n}d",
        title=f"{TITLE} in {n}-D",
        loss=valley,
        exact_loss=valley,
        start=lambda seed: jnp.asarray(np.resize([-1.2, 1.0], n)),
        reference=np.ones(n),
        bounds=(np.full(n, -5.0), np.full(n, 5.0)),
        sigma=0.3,
        budget=Budget(2000 * n, 60) if full else Budget(800 * n, 10),
        seeds=20 if full else 2,
        residuals=residuals,
        precision="float64",
        optimum=0.0,
    )
