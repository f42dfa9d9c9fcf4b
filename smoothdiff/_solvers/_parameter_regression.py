r"""Gauss-Newton from samples: the parameters regressed on the residuals, all in M x M matrices.

Near the iterate the residuals are modelled as $r(y + \sigma u) = m + J u + e$, $u \sim N(0, I)$,
where $e \sim N(0, \Gamma)$ is what a linear model cannot explain: pixels that jump, curvature. The
Gauss-Newton step that trusts each pixel as far as its noise allows is

$$ \hat u = -(J^T \Gamma^{-1} J + I)^{-1} J^T \Gamma^{-1} m
          = -\mathrm{Cov}(u, r) \, \mathrm{Cov}(r, r)^{-1} m, $$

a Levenberg-Marquardt step in the metric of the noise and, in its second form, the linear
regression of $u$ on $r$, asked for residuals of zero. The second form needs no Jacobian: M samples
enter by their inner products alone, so neither n parameters nor P residuals form a square matrix.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from smoothdiff._products import dot

# how far the linear model is trusted, in units of sigma
_REACH = 3.0
# how many ridges the marginal likelihood chooses among
_RIDGES = 8
# regressions that hold the parameters at their bounds, at most
_TIMES = 2
# the weight of what no parameters can explain, over the smallest sum of squares seen
_MISFIT = 0.01
# ... and so much is enough: by then the metric is all but the identity
_LARGE = 100.0


def gauss_newton_step(
    u: Float[Array, "M n"],
    residuals: Float[Array, "M P"],
    valid: Bool[Array, " M"],
    low: Float[Array, " n"] | None,
    high: Float[Array, " n"] | None,
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """The step within the bounds, and its standard error, in the units of `u`.

    A parameter at a bound stays there if the sum of squares falls outwards. One that the step would
    take across a bound is put there. The step of the others is computed from residuals as they
    would be with those fixed.
    """
    # far from the iterate the linear model is off by about the square of the distance
    distance = jnp.mean(u**2, axis=1) / _REACH**2
    weight = jnp.where(valid, 1 / (1 + distance**2), 0)
    mean = dot(weight, residuals) / jnp.sum(weight)
    centred = (residuals - mean[None]) * jnp.sqrt(weight)[:, None]
    # the last row is the target, residuals of zero, seen from the mean
    rows = jnp.concatenate([centred, -mean[None]])
    gram = dot(rows, rows.T)
    if low is None or high is None:
        return _regress(gram, u, weight)
    slope = _gradient(gram, u, weight)
    active = ((low >= 0) & (slope > 0)) | ((high <= 0) & (slope < 0))

    def regress(carry: tuple) -> tuple:
        clipped: Array
        clipped, _, active, _, times = carry
        moved = _move(gram, u, weight, clipped, active)
        step, stderr = _regress(moved, jnp.where(active[None], 0, u), weight)
        step = jnp.where(active, clipped, step)
        clipped = jnp.clip(step, low, high)
        crossed = clipped != step
        return clipped, stderr, active | crossed, jnp.any(crossed), times + 1

    # once more only where the step would cross a bound
    none = jnp.zeros_like(low)
    again = lambda carry: carry[3] & (carry[4] < _TIMES)
    clipped, stderr, *_ = jax.lax.while_loop(again, regress, (none, none, active, True, 0))
    return clipped, stderr


def _regress(gram: Array, u: Array, weight: Array) -> tuple[Array, Array]:
    """The regression of `u` on the rows behind `gram`, at its last row: mean and deviation."""
    count, n = jnp.sum(weight > 0).astype(u.dtype), u.shape[1]
    inner, target, far = gram[:-1, :-1], gram[:-1, -1], gram[-1, -1]
    spread = jnp.trace(inner) / count
    unit = 1 / jnp.where(spread > 0, spread, 1)
    inner, target, far = inner * unit, target * unit, far * unit
    root = jnp.sqrt(weight)
    mean = dot(weight, u) / jnp.sum(weight)
    centred = (u - mean[None]) * root[:, None]

    eigenvalues, q = jnp.linalg.eigh(inner)
    eigenvalues = jnp.maximum(eigenvalues, 0)
    square = dot(q.T, centred) ** 2
    floor = 8 * len(weight) * jnp.finfo(u.dtype).eps
    ridges = jnp.geomspace(floor, 1, _RIDGES, dtype=u.dtype)
    # the empty rows and the constant are in the null space: they are no data
    null = len(weight) - count + 1

    tiny = jnp.finfo(u.dtype).tiny

    def likelihood(ridge: Array) -> Array:
        scale = jnp.sum(square / (eigenvalues + ridge)[:, None], axis=0) / count
        log_det = jnp.sum(jnp.log(eigenvalues + ridge)) - null * jnp.log(ridge)
        log_scale = jnp.sum(jnp.log(jnp.maximum(scale, tiny)))
        return -(count - 1) / 2 * log_scale - n / 2 * log_det

    # one after the other: XLA's product with all of them at once takes 60 times as long
    likelihoods = jax.lax.map(likelihood, ridges)
    ridge = ridges[jnp.argmax(likelihoods)]

    # What the linear model cannot reach is no sample's fault: it counts as noise, but only where
    # the parameters have no say. For residuals that never vanish this leaves plain Gauss-Newton.
    at = 1 / jnp.where(weight > 0, root, 1)
    squares = jnp.diagonal(inner) * at**2 - 2 * target * at + far
    lowest = jnp.min(jnp.where(weight > 0, jnp.maximum(squares, 0), jnp.inf))
    misfit = jnp.minimum(_MISFIT * lowest / n, _LARGE) * count
    left, _, _ = _svd(centred)
    unreached = _eye(inner) - dot(left, left.T)
    # by eigenvalues, since rounding may leave the matrix indefinite
    eigenvalues, q = jnp.linalg.eigh(inner + misfit * unreached)
    eigenvalues = jnp.maximum(eigenvalues, 0) + ridge
    along = dot(q.T, target)
    step = mean + dot(dot(q, along / eigenvalues), centred)

    # To a function that is all but linear, a target out of reach says nothing about the error.
    # The root is by experiment: the share itself gives up too early on plateaus.
    nonlinear = jnp.clip(jnp.sum(inner * unreached) / jnp.maximum(jnp.trace(inner), tiny), 0, 1)
    beyond = jnp.maximum(far - jnp.sum(along**2 / eigenvalues), 0) * jnp.sqrt(nonlinear)
    scale = jnp.sum(dot(q.T, centred) ** 2 / eigenvalues[:, None], axis=0) / count
    return step, jnp.sqrt((beyond + ridge / count) * scale)


def _eye(like: Array) -> Array:
    size = jnp.arange(len(like))
    return jnp.zeros_like(like).at[size, size].set(1)


def _svd(u: Array) -> tuple[Array, Array, Array]:
    """The singular value decomposition without its null space: zeros there, 1 / s in the middle."""
    eps = len(u) * jnp.finfo(u.dtype).eps
    if u.shape[0] >= u.shape[1]:
        left, s, right = jnp.linalg.svd(u, full_matrices=False)
        kept = s > eps * s[0]
    else:
        # of many parameters by the Gram matrix: several times as fast, at half of the digits
        squares: Array
        squares, left = jnp.linalg.eigh(dot(u, u.T))
        kept = squares > eps * squares[-1]
        s = jnp.sqrt(jnp.where(kept, squares, 1))
        right = dot(left.T, u) / s[:, None]
    left = jnp.where(kept[None], left, 0)
    return left, jnp.where(kept, 1 / jnp.where(kept, s, 1), 0), right


def _gradient(gram: Array, u: Array, weight: Array) -> Array:
    """The slope of half the sum of squares at the iterate, by the linear fit."""
    root, total = jnp.sqrt(weight), jnp.sum(weight)
    mean = dot(weight, u) / total
    left, inverse, right = _svd((u - mean[None]) * root[:, None])
    here = dot(left, inverse * dot(right, -mean))
    along = dot(gram[:-1, :-1], here) - gram[:-1, -1]
    return dot(inverse * dot(left.T, along), right)


def _move(gram: Array, u: Array, weight: Array, clipped: Array, active: Array) -> Array:
    """The Gram matrix of the residuals as they would be with the active parameters fixed."""
    root, total = jnp.sqrt(weight), jnp.sum(weight)
    centred = (u - (dot(weight, u) / total)[None]) * root[:, None]
    away = jnp.where(active[None], u - clipped[None], 0) * root[:, None]
    left, inverse, right = _svd(centred)
    # the linear fit's change of each row, then each row from the new mean
    moved = _eye(gram[1:, 1:]) - dot(dot(away, right.T) * inverse[None], left.T)
    mean = dot(root, moved) / total
    moved = moved - root[:, None] * mean[None]
    last = jnp.zeros_like(weight)[:, None]
    rows = jnp.concatenate([moved, last], axis=1)
    target = jnp.concatenate([-mean, jnp.ones_like(mean[:1])])
    change = jnp.concatenate([rows, target[None]])
    return dot(dot(change, gram), change.T)
