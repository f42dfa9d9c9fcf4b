"""Signs that a search by points has converged: a short step, or a loss of which nothing is left."""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from smoothdiff._params import Params
from smoothdiff._solvers._base import promotion
from smoothdiff._solvers._history import History
from smoothdiff._solvers._point_search import AbstractPointSearch
from smoothdiff._solvers._ratio_test import is_lower, taken_by_rounding

# values that are the same at points further apart than so many roots of the rounding: a plateau
_PLATEAU = 3
# a loss is nothing if it is so small beside the highest of those that are known, but for a quarter
# of them, which may be beyond all measure
_MOST, _NOTHING = 0.75, {"float32": 1e-10, "float64": 1e-20}


class Signs(NamedTuple):
    """Whether a step was `small`, of which several in a row tell, and whether no loss is less."""

    small: Bool[Array, ""]
    least: Bool[Array, ""]


def signs(
    solver: Any,
    params: Params,
    search: AbstractPointSearch,
    after: AbstractPointSearch,
    new: tuple[Float[Array, "K n"], Float[Array, "K P"], Float[Array, ""]],
    lowest_fun: Float[Array, ""],
) -> Signs:
    """What a step says of convergence.

    Args:
        solver: its tolerances.
        params: where the step began, and sigma.
        search: the search before the step.
        after: the same with what was evaluated.
        new: the points, of which the first is the model's step, what the function returned there,
            and the lowest value.
        lowest_fun: the lowest before.
    """
    points, rows, fun = new
    asked = (solver.rtol > 0) | (solver.atol > 0)
    with promotion():
        # parameters in one array may have very different units
        scale = jnp.maximum(jnp.abs(params.theta), params.sigma)
        rounding = math.sqrt(jnp.finfo(scale.dtype).eps) * scale
        # it has not converged while the function falls by more than rounding
        falls = lowest_fun - fun > taken_by_rounding(lowest_fun)
        tolerance = jnp.maximum(solver.atol + solver.rtol * scale, jnp.where(falls, 0, rounding))
        moved = (points[0] - params.theta) / jnp.maximum(tolerance, jnp.finfo(scale.dtype).tiny)
        ignored = after.ignored()
        counts = ~ignored | (fun < lowest_fun)
        short = asked & (solver.norm(params.layout.tree(jnp.where(counts, moved, 0))) < 1)
        # a point that only teaches the model is no step, but may show that none is left
        small = short & (~search.checking() | after.right())
        small |= asked & after.right() & ~is_lower(fun, lowest_fun)
        small |= asked & after.level()
        apart = jnp.where(ignored, jnp.inf, _PLATEAU * rounding)
        small &= after.settled() & ~after.plateau(apart)
        small &= after.average is None
    if not solver.squares:
        return Signs(small, jnp.asarray(False))
    # squares so small that all sums are zero say nothing
    known = ~(jnp.all(after.history.funs == 0) & jnp.any(rows != 0))
    below = jnp.minimum(fun, lowest_fun)
    least = (below == 0) | (short & ~search.teaches() & _is_nothing(below, after.history))
    return Signs(small & known, least & known & (after.average is None))


def _is_nothing(fun: Float[Array, ""], history: History) -> Bool[Array, ""]:
    """Whether a loss is nothing beside others, so that a short step needs no check."""
    known = jnp.where(history.valid, history.funs, jnp.nan)
    return fun <= _NOTHING[fun.dtype.name] * jnp.nanquantile(known, _MOST)
