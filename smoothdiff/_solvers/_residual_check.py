r"""A check of a linear model of residuals, where it asks for little or nothing.

Steps may be short since the model is wrong. Where the slopes along a unit direction u are known up
to an error of size $|S^T u|$, the loss may be lower there by

$$ \frac{|r|^2 \, |S^T u|^2}{2 \, |J u|^2} $$

than the model says. The check is one evaluation along the direction in which that is most, so far
away that the loss rises by a small share. If it rises about as predicted, what is left to gain in
this direction is a small part of that share.

Source: own; the criticality step of Conn, Scheinberg and Vicente 2009 has the same purpose.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from smoothdiff._products import dot
from smoothdiff._solvers._at_once import least_length
from smoothdiff._solvers._nearest_fit import Fit
from smoothdiff._solvers._ratio_test import TELLING, taken_by_rounding

# residuals change by this share at a check, so the loss rises by its square
_SHARE = 0.02
# a curvature of so many roundings is none
_FLAT = 100
# a model is right about a check whose change it predicted with an error below this share, and the
# rise within this factor
_RIGHT, _ABOUT = 0.1, 1.5
# ... after which the next one is so much nearer, as the same would say nothing
_NEXT = 0.8
# a check that changes hardly anything is followed by one so many times as far away, within sigma
_FARTHER = 4.0


class Check(NamedTuple):
    """Whether the model was right, and by what the radius changes."""

    right: Bool[Array, ""]
    factor: Float[Array, ""]


def check_step(
    fit: Fit,
    row: Float[Array, " P"],
    place: Float[Array, " n"],
    farthest: Float[Array, ""],
) -> Float[Array, " n"]:
    """From the center to the check, in units of sigma; the opposite is as good.

    Args:
        fit: of the model; its `spread` is S, but for a factor.
        row: the residuals at the center.
        place: the center, in these units.
        farthest: so far away the check may be, unless rounding spoils it there.
    """
    eps, tiny = jnp.finfo(row.dtype).eps, jnp.finfo(row.dtype).tiny
    # each parameter by what it changes, as squares of slopes have half of the digits
    size = jnp.linalg.norm(fit.jacobian, axis=1)
    unit = jnp.where(size > eps * jnp.max(size), 1 / jnp.maximum(size, tiny), 0)
    slopes = fit.jacobian * unit[:, None]
    curvatures, vectors = jnp.linalg.eigh(dot(slopes, slopes.T))
    # where residuals do not change, the loss hides nothing
    inverse = jnp.where(curvatures > _FLAT * eps, 1 / jnp.sqrt(jnp.maximum(curvatures, eps)), 0)
    spread = fit.spread * unit[:, None]
    uncertain = jnp.linalg.svd(dot(vectors.T, spread) * inverse[:, None])[0][:, 0]
    direction = dot(vectors, uncertain * inverse) * unit
    norm = jnp.linalg.norm(direction)
    direction = jnp.where(norm > 0, direction / jnp.maximum(norm, tiny), fit.lacking)
    slope = jnp.linalg.norm(dot(direction, fit.jacobian))
    length = _SHARE * jnp.linalg.norm(row) / jnp.maximum(slope, tiny)
    least = jnp.maximum(least_length(place), jnp.sqrt(eps))
    return jnp.maximum(jnp.minimum(length, farthest), least) * direction


def newer(step: Float[Array, " n"], known: Float[Array, "M n"]) -> Float[Array, " n"]:
    """The step or its opposite: that whose end is farther from what is known."""
    apart = lambda end: jnp.min(jnp.linalg.norm(known - end[None], axis=1))
    return jnp.where(apart(step) >= apart(-step), step, -step)


def checked(
    row: Float[Array, " P"],
    there: Float[Array, " P"],
    predicted: Float[Array, " P"],
    ahead: Float[Array, ""],
    good: Bool[Array, ""],
) -> Check:
    """What the residuals `there` say of a model that predicted others.

    A check that changes too little to tell, as predicted, is followed by one farther away, one that
    the model got wrong by a nearer one.

    Args:
        row: the residuals at the center.
        there: those at the check.
        predicted: those that the model predicted there.
        ahead: what it promises beyond the radius: where that is much, nothing has converged.
        good: whether this was a check, and gave numbers to compare.
    """
    before = jnp.sum(row**2) / 2
    off, expected = (jnp.linalg.norm(predicted - a) for a in (there, row))
    little = TELLING * jnp.finfo(row.dtype).eps * before
    rise, foreseen = (jnp.sum(a**2) / 2 - before for a in (there, predicted))
    about = (rise > foreseen / _ABOUT) & (rise < _ABOUT * foreseen)
    known = good & (off < _RIGHT * expected) & (about | ~(rise > little))
    right = known & (rise > little) & ~(ahead > taken_by_rounding(before))
    nothing = (jnp.abs(rise) <= little) & (foreseen <= little) & jnp.any(there != row)
    farther = (good & nothing) | (known & ~right)
    return Check(right, jnp.where(right, _NEXT, jnp.where(farther, _FARTHER, 0.5)))
