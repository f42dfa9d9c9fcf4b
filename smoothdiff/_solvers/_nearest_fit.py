r"""The Jacobian of the nearest evaluations: the fit that changes the last Jacobian least.

$$ \min_J \; \sum_i w_i \, |r_i - r - J (x_i - x)|^2 + \epsilon \, |J - J_{last}|^2 $$

x is the best point and r its residuals; the weights fall with the distance from it. Each
evaluation makes J better where a search goes.

Source: own; the least change is Broyden's.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from smoothdiff._products import dot
from smoothdiff._solvers._history import History

# evaluations that a fit may use for each parameter, and how far they count, in radii
_USED, _REACH, _FARTHEST = 3, 1.5, 2.0
# what is not known of a direction that hardly any evaluation has, against the others, squared
_RIDGE = 1e-8
# a direction with less than this share of the radius is not covered by evaluations
_COVERED = 0.2
# ... and evaluations cover the region, or this share of what the fit uses
_CLOSE = 0.05


def nearest_fit(
    history: History,
    center: Float[Array, " n"],
    row: Float[Array, " P"],
    sigma: Float[Array, " n"],
    radius: Float[Array, ""],
    last: Float[Array, "n P"],
) -> tuple[Float[Array, "n P"], Float[Array, " n"], Bool[Array, ""]]:
    """The Jacobian, and whether evaluations cover the region around its center.

    Args:
        history: evaluations, of which the nearest are used.
        center: the best point.
        row: its residuals.
        sigma: the unit of length, for each parameter.
        radius: of the region, in units of sigma.
        last: the Jacobian before, in units of sigma, as the one that is returned.

    Returns:
        The Jacobian; the unit direction that is covered least; whether that is too little.
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
    weight = jnp.where(used, 1 / (1 + (far / _REACH) ** 4), 0)
    a = jnp.where(used[:, None], away[near], 0) / width
    change = jnp.where(used[:, None], history.rows[near] - row[None], 0)
    # by singular values, since squares of them would take half of the digits
    root = jnp.sqrt(weight)
    left, values, right = jnp.linalg.svd(a * root[:, None], full_matrices=False)
    ridge = _RIDGE * jnp.sum(values**2) / n + tiny
    inverse = dot(right.T, (values / (values**2 + ridge))[:, None] * (left * root[:, None]).T)
    old = last * width
    correction = dot(inverse, change - dot(a, old))
    new = jnp.where(jnp.all(jnp.isfinite(correction)), old + correction, old)
    jacobian = jnp.asarray(new) / width
    close = far <= _FARTHEST * jnp.maximum(radius / width, _CLOSE)
    covered, directions = jnp.linalg.eigh(dot(jnp.where(close[:, None], a, 0).T, a))
    least = jnp.sqrt(jnp.maximum(covered[0], 0))
    return jacobian, directions[:, 0], least < _COVERED * radius / width
