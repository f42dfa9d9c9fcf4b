"""A negated Gaussian, -exp(-|y|²/2): indefinite or negative definite outside of its own width.

Appendix H of the paper on higher-order rendering: from every start of a grid over (-3, 3)² the
minimum is to be found. Its widths and normalisation are not stated there; here both the function
and its smoothing have width 1, and the function's lowest value is -1.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks._task import Budget, Task

TITLE = "Negated Gaussian: a minimum among indefinite Hessians"


def well(y: Float[Array, "2"]) -> Float[Array, ""]:
    """Lowest at the origin."""
    return -jnp.exp(-jnp.sum(y**2) / 2)


def starts(cells: int) -> np.ndarray:
    """The middles of cells x cells over (-3, 3)²; an even number leaves out the minimum."""
    line = (np.arange(cells) + 0.5) / cells * 6 - 3
    return np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)


def build(full: bool) -> Task:
    """Quick: a grid of 2 x 2; full: 6 x 6."""
    grid = starts(6 if full else 2)
    return Task(
        name="negated-gaussian",
        title=TITLE,
        loss=well,
        exact_loss=well,
        start=lambda seed: jnp.asarray(grid[seed % len(grid)]),
        reference=np.zeros(2),
        bounds=(np.full(2, -5.0), np.full(2, 5.0)),
        sigma=1.0,
        budget=Budget(2000, 30) if full else Budget(500, 10),
        seeds=len(grid),
        precision="float64",
        optimum=-1.0,
    )
