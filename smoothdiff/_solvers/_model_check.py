r"""A check of a quadratic model before its short steps are believed.

Where no evaluation is near, a model can take the center for the minimum that is elsewhere. Let that
be a distance $\delta$ away, along a direction in which the curvature is h. Then the function rises
over a distance d by $h d (d / 2 \pm \delta)$, and not by the $h d^2 / 2$ of the model. So one
evaluation tells whether $\delta$ is small against d. The direction is a flat one, since an error of
the gradient moves the minimum most there, unless a point about as near is known.

Source: our own; the criticality step of Conn, Scheinberg and Vicente 2009 has the same purpose.
"""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from smoothdiff._products import dot
from smoothdiff._solvers._at_once import least_length
from smoothdiff._solvers._least_change import Quadratic
from smoothdiff._solvers._metric import Metric
from smoothdiff._solvers._ratio_test import TELLING

# the check is so many steps away
_STEPS = 10.0
# a rise that is so many times higher or lower than predicted is right
_RIGHT = 2.0
# a point that is nearer to a known one than this share of its way is the same; of a way so many
# lengths are tried, each half of the one before
_KNOWN, _HALVES = 0.1, 4


def check_step(
    model: Quadratic,
    metric: Metric,
    center: Float[Array, " n"],
    fun: Float[Array, ""],
    step: Float[Array, " n"],
    radius: Float[Array, ""],
) -> Float[Array, " n"]:
    """From the center to the check, in units of the metric; the opposite is as good.

    Args:
        model: what is to be checked.
        metric: its units.
        center: where it says the minimum is.
        fun: the value there.
        step: the short step, in units of the metric.
        radius: that of the trust region, beyond which there is no check.
    """
    eps, tiny = jnp.finfo(fun.dtype).eps, jnp.finfo(fun.dtype).tiny
    curvatures, vectors = jnp.linalg.eigh(model.hessian)
    mean = jnp.mean(jnp.abs(curvatures)) + tiny

    def far_enough(curvature: Array) -> Array:
        rise = TELLING * eps * jnp.abs(fun)
        return jnp.sqrt(2 * rise / (jnp.abs(curvature) + tiny))

    # the largest parameter moves by the root of its rounding, or more
    least = least_length(center / metric.widest())
    length = jnp.maximum(jnp.maximum(_STEPS * jnp.linalg.norm(step), least), tiny)
    away = model.away / jnp.minimum(jnp.maximum(length, far_enough(mean)), radius)
    # a point that is about as far away tells as much of its direction as curvature would
    told = 2 * away / (1 + jnp.sum(away**2, axis=1, keepdims=True))
    flat = dot(vectors * jnp.minimum(jnp.abs(curvatures) / mean, 1)[None], vectors.T)
    direction = jnp.linalg.eigh(flat + dot(told.T, told))[1][:, 0]
    curvature = dot(direction, dot(model.hessian, direction))
    return jnp.minimum(jnp.maximum(length, far_enough(curvature)), radius) * direction


def to_new_place(
    ends: Float[Array, "k n"],
    known: Float[Array, "m n"],
    rise: Callable[[Float[Array, "K n"]], Float[Array, " K"]],
    least: Float[Array, ""],
) -> Float[Array, " n"]:
    """The first of these checks that ends at no known point, as of those any model is right.

    Where all do, halves of them follow; the last resort is the one that is farthest from all.

    Args:
        ends: from the center to a check.
        known: the points, seen from there.
        rise: what the model predicts at the end of steps.
        least: a half must rise by as much to tell anything.
    """
    halves = 2.0 ** -jnp.arange(_HALVES, dtype=ends.dtype)
    steps = (halves[:, None, None] * ends[None]).reshape(-1, ends.shape[1])
    tells = (jnp.arange(len(steps)) < len(ends)) | (rise(steps) > least)
    length = jnp.maximum(jnp.linalg.norm(steps, axis=1), jnp.finfo(ends.dtype).tiny)
    gaps = jnp.min(jnp.linalg.norm(steps[:, None] - known[None], axis=2), axis=1) / length
    new, farthest = tells & (gaps > _KNOWN), jnp.argmax(jnp.where(tells, gaps, -1))
    return steps[jnp.where(jnp.any(new), jnp.argmax(new), farthest)]


def least_rise(fun: Float[Array, ""]) -> Float[Array, ""]:
    """A check that rises by more than this tells something."""
    return TELLING / 2 * jnp.finfo(fun.dtype).eps * jnp.abs(fun)


def is_right(
    before: Float[Array, ""], fun: Float[Array, ""], rise: Float[Array, ""]
) -> Bool[Array, ""]:
    """Whether the function rises about as the model predicts, by enough to tell.

    Args:
        before: the value at the center.
        fun: the value at the check.
        rise: by how much that is higher, as the model predicts.
    """
    about = (fun - before > rise / _RIGHT) & (fun - before < rise * _RIGHT)
    return about & (rise > least_rise(before))
