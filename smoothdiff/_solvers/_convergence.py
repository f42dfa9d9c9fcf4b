"""Signs that a search by points has converged: short steps, and a loss of which little is left.

Source: own; that a loss of 1e-20 of the first one is enough is the rule of DFO-LS (Cartis, Fiala,
Marteau and Roberts, 2019), which needs no short step.
"""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from smoothdiff._params import Params
from smoothdiff._solvers._base import promotion
from smoothdiff._solvers._point_search import AbstractPointSearch
from smoothdiff._solvers._ratio_test import is_lower, taken_by_rounding

# values that are the same at points further apart than so many roots of the rounding: a plateau
_PLATEAU = 3
# next to nothing is left of a loss that is so small a share of the usual one
_LEFT = {"float32": 1e-10, "float64": 1e-20}


class Signs(NamedTuple):
    """Whether a step was `small`, of which several in a row tell, or is the `last` of the search.

    No loss is less than the `least`.
    """

    small: Bool[Array, ""]
    last: Bool[Array, ""]
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

    Returns:
        What holds after the step.
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
        tells = after.settled() & ~after.plateau(apart)
    no = jnp.asarray(False)
    if after.average is not None:
        return Signs(no, no, no)
    if not solver.squares:
        return Signs(small & tells, no, no)
    # squares so small that all sums are zero say nothing
    known = ~(jnp.all(after.history.funs == 0) & jnp.any(rows != 0))
    last = no
    # where searches follow, one that may be in a local minimum is not cut short
    if not solver.restarts:
        # nor one of a model that has not shown yet that it is right
        step = search.is_local() & ~search.checking() & search.settled()
        last = step & short & tells & _little_is_left(after)
    return Signs(small & tells & known, last & known, (jnp.minimum(fun, lowest_fun) == 0) & known)


def _little_is_left(search: AbstractPointSearch) -> Bool[Array, ""]:
    """Whether next to nothing is left of the loss, so that a short step needs no check."""
    history = search.history
    usual = history.usual()
    return history.best(search.start)[2] <= _LEFT[usual.dtype.name] * usual
