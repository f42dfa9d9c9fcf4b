"""What `coarse_to_fine` is given and returns: levels of a function, and what was found on them."""

import dataclasses
import itertools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

from jaxtyping import PyTree

from smoothdiff._result import Result
from smoothdiff._solvers import AbstractSmoothSolver


class Level(NamedTuple):
    """A version of a function, and what an evaluation of it costs.

    Attributes:
        fun: as for `minimise` or `least_squares`. The residuals of two levels may differ in number.
        cost: in any unit that all levels share: seconds, rays, time steps.

    Example:
        >>> import jax.numpy as jnp, smoothdiff as sd
        >>> def drawn(pixels):
        ...     x = (jnp.arange(pixels) + 0.5) / pixels
        ...     bar = lambda y: (x < y).astype(float)
        ...     return sd.Level(lambda y, args: bar(y) - bar(0.7), cost=pixels)
        >>> [drawn(pixels).cost for pixels in (16, 256)]
        [16, 256]

    Source: own.
    """

    fun: Callable[..., Any]
    cost: float


@dataclasses.dataclass(frozen=True)
class CoarseToFine:
    """What `coarse_to_fine` found.

    Attributes:
        levels: the result of each search, the coarsest level's first. The finest level may have
            two.
        evaluations: of each level that was reached.
        cost: what all evaluations cost together, in evaluations of the finest level.
        reason: why the search ended, as in `Result`; or "max_cost".

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> def drawn(pixels):
        ...     x = (jnp.arange(pixels) + 0.5) / pixels
        ...     bar = lambda y: (x < y).astype(float)
        ...     return sd.Level(lambda y, args: bar(y) - bar(0.7), cost=pixels)
        >>> found = sd.coarse_to_fine(
        ...     sd.least_squares, [drawn(16), drawn(64)], 0.4, key=jax.random.key(0), bounds=(0, 1)
        ... )
        >>> len(found.levels), round(float(found.y), 1)
        (2, 0.7)

    Source: own.
    """

    levels: tuple[Result, ...]
    evaluations: tuple[int, ...]
    cost: float
    reason: str

    @property
    def y(self) -> PyTree:
        """The best point of the finest level that was reached."""
        return self.levels[-1].y

    @property
    def fun(self) -> float:
        """The value there of that level's function."""
        return self.levels[-1].fun


def check_levels(levels: Any, max_cost: float | None, options: dict[str, Any]) -> None:
    """Raises TypeError or ValueError for levels that are none, and options that have no place."""
    if not levels or not all(isinstance(level, Level) for level in levels):
        raise TypeError("levels must be a list of sd.Level(fun, cost), from coarse to fine")
    costs = [level.cost for level in levels]
    if not all(0 < a <= b < math.inf for a, b in itertools.pairwise([costs[0], *costs])):
        raise ValueError(f"the costs of levels must be positive and not fall, not {costs}")
    if max_cost is not None and not 0 < max_cost < math.inf:
        raise ValueError(f"max_cost={max_cost} must be a positive number, or None for no limit")
    for name in options.keys() & {"max_evaluations", "max_steps", "checkpoint"}:
        raise ValueError(f"{name}= is of one level: use max_cost, max_seconds or target")
    solver = options.get("solver")
    if solver is not None and not isinstance(solver, AbstractSmoothSolver):
        raise TypeError("give the solver itself, such as GaussNewton(sigma), not one around it")
    if callable(options.get("sigma")) or callable(getattr(solver, "sigma", None)):
        raise ValueError("a sigma that is a schedule cannot be for several levels: give a number")
