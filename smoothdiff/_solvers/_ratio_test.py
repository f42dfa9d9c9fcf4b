"""The ratio test of a trust region: what the value at the end of a step says of the model."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

# a step fails at this acceptance ratio, and is very successful above the other one
LEAST, _VERY = 0.1, 0.7
# a step that raises the function by so many times the predicted reduction was far too long
_FAR_OFF = 10.0
# a step of this share of the radius would have been longer without it
INSIDE = 0.95
# a reduction of so many roundings of the value is nothing, a rise of so many is one for sure
_NOTHING, TELLING = 8, 1000
# what moves the parameters or the value by so few roundings may be lost in those of the function's
# own sums; in float32 more of them would be too much to do without
FEW = {"float32": 8, "float64": 64}
# a parameter's range in sigmas, by the default sigma
_RANGE = 5
# a reduction of a smaller share of the value is no progress, nor one of few roundings
_PROGRESS = 1e-8
# points are near each other within so many sigmas
_NARROW = 1e-3
# a width of so many roundings of sigma is nothing
_NO_WIDTH = 32


class Outcome(NamedTuple):
    """What came of a step; all are false where none was `tried`, as for a point of geometry.

    After a `very_successful` step, whose reduction came true, the radius may grow. One that
    `failed` may have been `long`: far too long. Then the scale is wrong, which says nothing against
    the model. `fails` counts the other failures in a row. The model promised `more` than rounding
    may take.
    """

    tried: Bool[Array, ""]
    failed: Bool[Array, ""]
    very_successful: Bool[Array, ""]
    long: Bool[Array, ""]
    fails: Int[Array, ""]
    more: Bool[Array, ""]


class Asked(NamedTuple):
    """Whether the radius is `tight`, and whether there is `nothing` to try within it.

    The radius is tight where no step within it promises more than rounding takes, but a longer one
    may, or where the model cannot know.
    """

    tight: Bool[Array, ""]
    nothing: Bool[Array, ""]


def ratio_test(
    before: Float[Array, ""],
    fun: Float[Array, ""],
    reduction: Float[Array, ""],
    fails: Int[Array, ""],
) -> Outcome:
    r"""The outcome by the acceptance ratio, actual over predicted reduction.

    $$ \rho = \frac{f(x) - f(x + p)}{m(x) - m(x + p)} $$

    Args:
        before: the value where the step began.
        fun: the value at its end, infinite where there is none.
        reduction: what the model predicted; zero where no step was tried.
        fails: the failures in a row before this step.

    Source: the test is that of Powell 1975; that a step far too long is no failure is our own.
    """
    tried = reduction > 0
    ratio = jnp.where(tried, (before - fun) / jnp.where(tried, reduction, 1), 0)
    failed = tried & ~(ratio > LEAST)
    long = failed & jnp.isfinite(ratio) & (ratio < -_FAR_OFF)
    count = jnp.where(failed & ~long, fails + 1, jnp.where(tried & ~failed, 0, fails))
    more = reduction > taken_by_rounding(before)
    return Outcome(tried, failed, tried & (ratio > _VERY), long, count, more)


def taken_by_rounding(fun: Float[Array, ""]) -> Float[Array, ""]:
    """So much of a reduction may be rounding."""
    return jnp.sqrt(jnp.finfo(fun.dtype).eps) * jnp.abs(fun)


def lost_in_rounding(
    move: Float[Array, " n"], center: Float[Array, " n"], sigma: Float[Array, " n"]
) -> Bool[Array, ""]:
    """Whether a step moves parameters by so few roundings that what it promises may be lost.

    A parameter near zero has the roundings of its range: its own are shorter than those of a sum
    with others.

    Args:
        move: the step, in the units of the parameters.
        center: where it begins.
        sigma: that of each parameter, a fifth of its range.
    """
    roundings = FEW[move.dtype.name] * jnp.finfo(move.dtype).eps
    return jnp.all(jnp.abs(move) <= roundings * jnp.maximum(jnp.abs(center), _RANGE * sigma))


def is_lower(fun: Float[Array, ""], before: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether a value is lower than another by more than rounding."""
    return before - fun > _NOTHING * jnp.finfo(fun.dtype).eps * jnp.abs(before)


def noticeable(fun: Float[Array, ""]) -> Float[Array, ""]:
    """A reduction to this value, in many evaluations, is progress if it is more."""
    share = max(_PROGRESS, _NOTHING * _NOTHING * float(jnp.finfo(fun.dtype).eps))
    return share * jnp.abs(fun)


def are_level(funs: Float[Array, " K"], valid: Bool[Array, " K"]) -> Bool[Array, ""]:
    """Whether these values are all the same, to the last bit."""
    lowest = jnp.min(jnp.where(valid, funs, jnp.inf))
    return (jnp.sum(valid) > 1) & jnp.all(~valid | (funs == lowest))


def is_narrow(width: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether points so many sigmas apart are near each other."""
    return width < _NARROW


def rounding_alone(
    funs: Float[Array, " K"], valid: Bool[Array, " K"], width: Float[Array, ""]
) -> Bool[Array, ""]:
    """Whether values of points that are near each other differ by rounding alone.

    Then there are more of them than levels between the lowest and the highest.

    Args:
        funs: The values.
        valid: Which of them count.
        width: How far apart the points are, in units of sigma.
    """
    levels = jnp.sort(jnp.where(valid, funs, jnp.inf))
    gaps = jnp.diff(levels)
    unit = jnp.min(jnp.where((gaps > 0) & jnp.isfinite(gaps), gaps, jnp.inf))
    highest = jnp.max(jnp.where(valid, funs, -jnp.inf))
    spread = highest - levels[0]
    count = jnp.sum(valid)
    # of one value, or none, nothing is known
    few = (count > 1) & (spread < (count - 1).astype(unit.dtype) * unit)
    little = spread <= taken_by_rounding(highest)
    return few & little & is_narrow(width)


def settled(
    before: Bool[Array, ""],
    outcome: Outcome,
    length: Float[Array, ""],
    radius: Float[Array, ""],
) -> Bool[Array, ""]:
    """Whether a short step is a sign of convergence, from whether the one before was.

    It is none where the radius alone made it short, as in a valley, or since a step failed that
    promised more than rounding may take, as where a function jumps.
    """
    worked = outcome.tried & ~outcome.failed
    inside = (length < INSIDE * radius) | ~(outcome.more | worked)
    return inside & (before | worked) & ~(outcome.failed & outcome.more)


def asks_nothing(
    reduction: Float[Array, ""],
    fun: Float[Array, ""],
    rise: Float[Array, ""],
    step: Float[Array, " n"],
    radius: Float[Array, ""],
) -> Asked:
    """Whether a model has anything to try.

    A model knows that it has not only if its values rise by far more than rounding. And the radius
    must not be too small for a promise, as it can be where the function is large.

    Args:
        reduction: what the step promises.
        fun: the value where it begins.
        rise: how far above that the highest value is that the model is fitted to.
        step: the minimiser within the radius, in the same units.
        radius: that of the trust region.
    """
    unit = jnp.finfo(fun.dtype).eps * jnp.abs(fun)
    little = ~(reduction > _NOTHING * unit)
    inside = jnp.linalg.norm(step) < INSIDE * radius
    done = little & (rise > TELLING * unit) & inside
    return Asked(little & ~done, done | ~(reduction > unit))


def nothing(width: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether a width, relative to sigma, is so small that the function cannot be told apart."""
    return width <= _NO_WIDTH * jnp.finfo(width.dtype).eps
