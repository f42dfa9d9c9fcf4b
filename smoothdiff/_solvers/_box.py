"""The box of parameters that have bounds to both sides, and places in it."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from smoothdiff._params import Params

# without bounds a place is so far away, relative to sigma, as a power of two at random
_WIDTHS = 2.0


def has_box(params: Params) -> Bool[Array, ""]:
    """Whether all parameters have finite bounds."""
    if params.bounds is None:
        return jnp.asarray(False)
    return jnp.all(jnp.isfinite(jnp.stack(params.bounds)))


def over_box(
    params: Params,
    draw: Callable[[], Float[Array, "k n"]],
    at: Int[Array, " K"],
    otherwise: Float[Array, "K n"],
) -> Float[Array, "K n"]:
    """Points spread over the box as normal ones are over space; without a box the others.

    Args:
        params: the bounds.
        draw: makes samples that are standard normal, not called without bounds.
        at: which of them are taken.
        otherwise: as many other points.
    """
    if params.bounds is None:
        return otherwise
    low, high = params.bounds
    z = draw()
    share = jax.scipy.special.ndtr(z)[jnp.minimum(at, len(z) - 1)]
    return jnp.where(has_box(params), low[None] + share * (high - low)[None], otherwise)


def turned_inside(
    params: Params, start: Float[Array, " n"], steps: Float[Array, "K n"]
) -> Float[Array, "K n"]:
    """The ends of steps from there, or half of the opposite one where a bound cuts off most of it.

    Half, so that a step and its opposite still end at two points.
    """
    ends, opposite = (jax.vmap(params.clip)(start[None] + s) for s in (steps, -steps))
    room, beyond = (jnp.abs(end - start[None]) for end in (ends, opposite))
    return jnp.where(room < beyond / 2, (start[None] + opposite) / 2, ends)


def anywhere(params: Params, key: Array, lowest: Float[Array, " n"]) -> Float[Array, " n"]:
    """A point within the bounds; without them, around the lowest so far at a random width."""
    key, other = jax.random.split(key)
    n, dtype = params.theta.size, params.theta.dtype
    if params.bounds is None:
        inside = jnp.full(n, jnp.inf, dtype)
    else:
        low, high = params.bounds
        inside = low + jax.random.uniform(key, (n,), dtype) * (high - low)
    power = jax.random.uniform(other, (), dtype, -_WIDTHS, _WIDTHS)
    around = lowest + params.sigma * 2.0**power * jax.random.normal(key, (n,), dtype)
    return params.clip(jnp.where(jnp.isfinite(inside), inside, around))
