r"""The Jacobian of the nearest evaluations: the fit that changes the last Jacobian least.

$$ \min_J \; \sum_i w_i \, |r_i - r - J (x_i - x)|^2 + \epsilon \, |J - J_{last}|^2, \qquad
   w_i = \frac{1}{1 + (|x_i - x| / l)^4} $$

x is the best point and r its residuals. Each evaluation makes J better where a search goes. What a
linear model leaves out of a smooth function grows with the square of the distance, so far
evaluations hardly count beside near ones. Rounding and noise are the same at all distances. About
at the length l both are as much: how far off the last Jacobian is nearby and farther away says
where that is.

Source: own; the least change is Broyden's.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from smoothdiff._products import dot
from smoothdiff._solvers._history import History

# evaluations that a fit may use for each parameter, and how far away, in widths
_USED, _FARTHEST = 3, 2.0
# the length, in widths, where all is noise
_REACH = 1.5
# it is at least this share of the radius, and this one of the width, as a radius that failures made
# small says less of the function than of its jumps
_ALIKE, _NEAR = 0.75, 0.075
# what is not known of a direction that hardly any evaluation has, against the others, squared
_RIDGE = 1e-8
# a direction with less than this share of the radius is not covered by evaluations
_COVERED = 0.2
# ... and evaluations cover the region, or this share of what the fit uses
_CLOSE = 0.05


class Fit(NamedTuple):
    """The Jacobian, and what evaluations leave uncertain.

    The unit direction that is covered least is `lacking`, and what they say of it may be `poor`.
    `spread` is the root of the uncertainty of slopes, but for a factor.
    """

    jacobian: Float[Array, "n P"]
    lacking: Float[Array, " n"]
    poor: Bool[Array, ""]
    spread: Float[Array, "n n"]


def nearest_fit(
    history: History,
    center: Float[Array, " n"],
    row: Float[Array, " P"],
    sigma: Float[Array, " n"],
    radius: Float[Array, ""],
    last: Float[Array, "n P"],
) -> Fit:
    """The Jacobian around a center, and what is not known of it.

    Args:
        history: evaluations, of which the nearest are used.
        center: the best point.
        row: its residuals.
        sigma: the unit of length, for each parameter.
        radius: of the region, in units of sigma.
        last: the Jacobian before, in units of sigma, as the one that is returned.
    """
    n = len(center)
    tiny = jnp.finfo(row.dtype).tiny
    away = (history.points - center[None]) / sigma[None]
    all_of_them = jnp.where(history.valid, jnp.linalg.norm(away, axis=1), jnp.inf)
    count = min(_USED * (n + 1), len(away))
    nearest: Array
    nearest, near = jax.lax.top_k(-jnp.asarray(all_of_them), count)
    distance = -nearest
    # as wide as n evaluations, the center not counted, or the whole region
    farthest = jnp.max(jnp.where(jnp.isfinite(distance[: n + 1]), distance[: n + 1], 0))
    width = jnp.maximum(jnp.maximum(radius, farthest), tiny)
    used = distance <= _FARTHEST * width
    far = jnp.asarray(jnp.where(used, distance, 0)) / width
    a = jnp.where(used[:, None], away[near], 0) / width
    old = last * width
    off = jnp.where(used[:, None], history.rows[near] - row[None], 0) - dot(a, old)
    least = jnp.maximum(_ALIKE * radius / width, _NEAR)
    length = jnp.maximum(_noise_length(jnp.linalg.norm(off, axis=1), far), least)
    weight = jnp.where(used, 1 / (1 + (far / length) ** 4), 0)
    # by singular values, since squares of them would take half of the digits
    root = jnp.sqrt(weight)
    left, values, right = jnp.linalg.svd(a * root[:, None], full_matrices=False)
    ridge = _RIDGE * jnp.sum(values**2) / n + tiny
    inverse = dot(right.T, (values / (values**2 + ridge))[:, None] * (left * root[:, None]).T)
    correction = dot(inverse, off)
    new = jnp.where(jnp.all(jnp.isfinite(correction)), old + correction, old)
    jacobian = jnp.asarray(new) / width
    close = far <= _FARTHEST * jnp.maximum(radius / width, _CLOSE)
    covered, directions = jnp.linalg.eigh(dot(jnp.where(close[:, None], a, 0).T, a))
    poor = jnp.sqrt(jnp.maximum(covered[0], 0)) < _COVERED * radius / width
    spread = right.T * jnp.sqrt((ridge + values[-1] ** 2) / (ridge + values**2))[None]
    return Fit(jacobian, directions[:, 0], poor, spread)


def _noise_length(off: Float[Array, " K"], far: Float[Array, " K"]) -> Float[Array, ""]:
    """How far, in widths, a linear model is off by no more than noise.

    Args:
        off: how far the last one is, at evaluations from near to far.
        far: their distances in widths; one at the center, or not used, has none.
    """
    some = far > 0
    near = some & (2 * jnp.cumsum(some) <= jnp.sum(some))
    noise = jnp.min(jnp.where(near, off, jnp.inf))
    most = jnp.max(jnp.where(some, off, 0))
    share = jnp.where(most > 0, noise / jnp.where(most > 0, most, 1), 1)
    return _REACH * jnp.sqrt(jnp.minimum(share, 1))
