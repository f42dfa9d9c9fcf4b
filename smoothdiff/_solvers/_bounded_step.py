"""The step that a quadratic model asks for within a radius and bounds: by eigenvalues, exactly."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from smoothdiff._products import dot

# steps along the bounds at most, and the shares of each that are tried and clipped
_TIMES, _SHARES = 10, tuple(2.0**-k for k in range(6))
_ROUNDING = 8
# Newton's method on the length of the step: from below it is monotone, and nearly quadratic
_SECULAR = 12


def bounded_step(
    hessian: Float[Array, "n n"],
    grad: Float[Array, " n"],
    radius: Float[Array, ""],
    low: Float[Array, " n"] | None,
    high: Float[Array, " n"] | None,
    shape: Float[Array, "n n"] | None = None,
) -> Float[Array, " n"]:
    r"""Minimises $g \cdot p + \tfrac12 p \cdot H p$ over $|p| \le r$ and $l \le p \le h$.

    With a `shape` B, the radius is one of $\sqrt{p \cdot B p}$.

    Exactly, where no bound is met. Where one is, by steps from zero, each of them the minimiser
    over the parameters that may still move, up to the first bound or clipped, whichever is lower.
    So the model never rises; a corner of the region may then be further away than its radius. H may
    be indefinite.

    Source: Moré and Sorensen 1983; Bertsekas 1982 for the bounds.
    """
    everything = jnp.ones(grad.shape, bool)
    if low is None or high is None:
        return _within(hessian, grad, radius, everything, shape)
    reach = radius if shape is None else radius * _extent(shape)
    near, far = jnp.maximum(low, -reach), jnp.minimum(high, reach)
    shares = jnp.asarray(_SHARES, grad.dtype)
    # a step to a bound ends there but for rounding
    margin = _ROUNDING * jnp.finfo(grad.dtype).eps * (far - near)

    def again(carry: tuple) -> tuple:
        p: Array
        p, value, _, times = carry
        slope = grad + dot(hessian, p)
        at_low, at_high = p <= near + margin, p >= far - margin
        free = ~((at_low & (slope > 0)) | (at_high & (slope < 0)))
        step = _within(hessian, slope, radius, free, shape)
        crossed = jnp.any((p + step < low) | (p + step > high))
        room = jnp.where(step > 0, far - p, near - p)
        moves = step != 0
        first = jnp.min(jnp.where(moves, room / jnp.where(moves, step, 1), jnp.inf))
        tried = jnp.append(shares, jnp.minimum(first, 1))
        ends = jnp.clip(p[None] + tried[:, None] * step[None], near[None], far[None])
        values = dot(ends, grad) + jnp.sum(dot(ends, hessian) * ends, axis=1) / 2
        best = jnp.argmin(values)
        lower = values[best] < value
        p = jnp.where(lower, ends[best], p)
        # without a bound in the way the step is the minimiser
        return p, jnp.minimum(values[best], value), lower & crossed, times + 1

    going = lambda carry: carry[2] & (carry[3] < _TIMES)
    start = jnp.zeros_like(grad), jnp.zeros_like(radius), jnp.asarray(True), 0
    return jax.lax.while_loop(going, again, start)[0]


def _extent(shape: Array) -> Array:
    """How far the unit ball of a shape reaches along each parameter."""
    return jnp.linalg.norm(_inverse_root(shape), axis=0)


def _inverse_root(shape: Array) -> Array:
    """L^-1 of the Cholesky factor L."""
    identity = jnp.eye(len(shape), dtype=shape.dtype)
    return jax.scipy.linalg.solve_triangular(jnp.linalg.cholesky(shape), identity, lower=True)


def _within(
    hessian: Array, grad: Array, radius: Array, free: Bool[Array, " n"], shape: Array | None
) -> Array:
    """The minimiser over the ball, of the free parameters alone."""
    size = jnp.arange(len(grad))
    both, active = free[:, None] & free[None], jnp.where(free, 0, 1)
    hessian = jnp.where(both, hessian, 0).at[size, size].add(active)
    grad = jnp.where(free, grad, 0)
    if shape is None:
        return jnp.where(free, _within_ball(hessian, grad, radius), 0)
    # in coordinates in which the shape is a ball
    root = _inverse_root(jnp.where(both, shape, 0).at[size, size].add(active))
    step = _within_ball(dot(dot(root, hessian), root.T), dot(root, grad), radius)
    return jnp.where(free, dot(root.T, step), 0)


def _within_ball(hessian: Array, grad: Array, radius: Array) -> Array:
    """The minimiser over the ball."""
    tiny, eps = jnp.finfo(grad.dtype).tiny, jnp.finfo(grad.dtype).eps
    values, vectors = jnp.linalg.eigh(hessian)
    along = dot(vectors.T, grad)
    least = jnp.maximum(-values[0], 0) + eps * jnp.max(jnp.abs(values)) + tiny

    def length(shift: Array) -> tuple[Array, Array]:
        p = along / (values + shift)
        return jnp.linalg.norm(p), jnp.sum(p**2 / (values + shift))

    def newton(shift: Array, _: None) -> tuple[Array, None]:
        size, slope = length(shift)
        more = (size / radius - 1) * size**2 / jnp.maximum(slope, tiny)
        return shift + jnp.maximum(jnp.where(jnp.isfinite(more), more, 0), 0), None

    shift, _ = jax.lax.scan(newton, least, None, length=_SECULAR)
    p = -along / (values + shift)
    size = jnp.linalg.norm(p)
    # where the model falls for ever, along the lowest curvature to the boundary
    rest = jnp.sqrt(jnp.maximum(radius**2 - size**2, 0))
    side = jnp.where(along[0] > 0, -1, 1).astype(p.dtype)
    p = p.at[0].add(jnp.where(values[0] < 0, side * rest, 0))
    p = dot(vectors, p)
    return p * jnp.minimum(1, radius / jnp.maximum(jnp.linalg.norm(p), tiny))
