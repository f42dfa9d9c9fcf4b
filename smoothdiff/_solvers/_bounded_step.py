"""The step that a quadratic model asks for within a radius and bounds: by eigenvalues, exactly."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from smoothdiff._solvers._base import dot

# how often a step that crosses bounds is computed again with those parameters held
_TIMES = 3
# Newton's method on the length of the step: from below it is monotone, and nearly quadratic
_SECULAR = 12


def bounded_step(
    hessian: Float[Array, "n n"],
    grad: Float[Array, " n"],
    radius: Float[Array, ""],
    low: Float[Array, " n"] | None,
    high: Float[Array, " n"] | None,
) -> Float[Array, " n"]:
    r"""Minimises $g \cdot p + \tfrac12 p \cdot H p$ over $|p| \le r$ and $l \le p \le h$, about.

    Exactly where no bound is met. A parameter that would cross one is put there, and the step of
    the others is computed again. H may be indefinite.

    Source: Moré and Sorensen 1983.
    """
    everything = jnp.ones(grad.shape, bool)
    if low is None or high is None:
        return _within(hessian, grad, radius, everything)

    def again(carry: tuple) -> tuple:
        p: Array
        free: Array
        p, free, _, times = carry
        held: Array = jnp.where(free, 0, p)
        step = _within(hessian, grad + dot(hessian, held), radius, free)
        step = jnp.where(free, step, held)
        p = jnp.clip(step, low, high)
        crossed = free & (p != step)
        return p, free & ~crossed, jnp.any(crossed), times + 1

    going = lambda carry: carry[2] & (carry[3] < _TIMES)
    start = jnp.zeros_like(grad), everything, jnp.asarray(True), 0
    return jax.lax.while_loop(going, again, start)[0]


def _within(hessian: Array, grad: Array, radius: Array, free: Bool[Array, " n"]) -> Array:
    """The minimiser over the ball, of the free parameters alone."""
    tiny, eps = jnp.finfo(grad.dtype).tiny, jnp.finfo(grad.dtype).eps
    size = jnp.arange(len(grad))
    hessian = jnp.where(free[:, None] & free[None], hessian, 0)
    hessian = hessian.at[size, size].add(jnp.where(free, 0, 1))
    values, vectors = jnp.linalg.eigh(hessian)
    along = dot(vectors.T, jnp.where(free, grad, 0))
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
    return jnp.where(free, p * jnp.minimum(1, radius / jnp.maximum(jnp.linalg.norm(p), tiny)), 0)
