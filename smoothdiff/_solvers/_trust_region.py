"""The step that a quadratic model asks for within a radius: truncated conjugate gradients."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from smoothdiff._products import dot

_MOST_STEPS = 100


def truncated_cg(
    curvature: Callable[[Array], Array],
    grad: Float[Array, " n"],
    radius: Float[Array, ""],
) -> Float[Array, " n"]:
    r"""Minimises $g \cdot p + \tfrac12 p \cdot H p$ over $|p| \le r$, about.

    Conjugate gradients from zero. Where they meet negative curvature or the boundary they follow
    the direction at hand to the boundary and end, so an indefinite H does no harm.

    Source: Steihaug 1983; Toint 1981.
    """
    # a little smaller than one can hope for: the direction counts, the last digit does not
    goal = jnp.linalg.norm(grad) * jnp.sqrt(jnp.finfo(grad.dtype).eps)

    def going(state):
        step, _, residual, _, done = state
        return ~done & (step < min(2 * grad.size, _MOST_STEPS)) & (jnp.linalg.norm(residual) > goal)

    def advance(state):
        step, p, residual, direction, _ = state
        bent = curvature(direction)
        along = dot(direction, bent)
        size = dot(residual, residual)
        alpha = size / jnp.where(along > 0, along, 1)
        beyond = (along <= 0) | (jnp.linalg.norm(p + alpha * direction) >= radius)
        p_new = p + jnp.where(beyond, _to_boundary(p, direction, radius), alpha) * direction
        residual_new = residual + alpha * bent
        beta = dot(residual_new, residual_new) / size
        return step + 1, p_new, residual_new, beta * direction - residual_new, beyond

    start = 0, jnp.zeros_like(grad), grad, -grad, ~(jnp.linalg.norm(grad) > 0)
    return jax.lax.while_loop(going, advance, start)[1]


def _to_boundary(p: Array, direction: Array, radius: Array) -> Array:
    """The positive t with |p + t d| = r."""
    a, b = dot(direction, direction), dot(p, direction)
    c = dot(p, p) - radius**2
    # b is not negative along conjugate gradients from zero, so nothing cancels in the denominator
    return -c / (b + jnp.sqrt(jnp.maximum(b * b - a * c, 0)))
