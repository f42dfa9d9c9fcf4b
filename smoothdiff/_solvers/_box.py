"""The box of parameters that have bounds to both sides, and places in it."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from smoothdiff._params import Params

# without bounds a place is so far away, relative to sigma, as a power of two at random
_WIDTHS = 2.0


def bounded(params: Params) -> bool:
    """Whether there are bounds to both sides, open or not."""
    return params.low is not None and params.high is not None


def bounds_of(params: Params) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Those of parameters that are `bounded`.

    Raises:
        ValueError: they are not.
    """
    if params.low is None or params.high is None:
        raise ValueError("this goes from bound to bound: give bounds")
    return params.low, params.high


def closed(params: Params) -> Bool[Array, ""]:
    """Whether all of these bounds are finite."""
    return jnp.all(jnp.isfinite(jnp.stack(bounds_of(params))))


def has_box(params: Params) -> Bool[Array, ""]:
    """Whether all parameters have finite bounds."""
    return closed(params) if bounded(params) else jnp.asarray(False)


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
    if not bounded(params):
        return otherwise
    low, high = bounds_of(params)
    z = draw()
    share = jax.scipy.special.ndtr(z)[jnp.minimum(at, len(z) - 1)]
    return jnp.where(closed(params), low[None] + share * (high - low)[None], otherwise)


def turned_inside(
    params: Params, start: Float[Array, " n"], steps: Float[Array, "K n"]
) -> Float[Array, "K n"]:
    """The ends of steps from there, or half of the opposite one where a bound cuts off most of it.

    Half, so that a step and its opposite still end at two points.
    """
    ends, opposite = (jax.vmap(params.clip)(start[None] + s) for s in (steps, -steps))
    room, beyond = (jnp.abs(end - start[None]) for end in (ends, opposite))
    cut = (room < jnp.abs(steps) / 2) & (room < beyond)
    return jnp.where(cut, (start[None] + opposite) / 2, ends)


def anywhere(params: Params, key: Array, lowest: Float[Array, " n"]) -> Float[Array, " n"]:
    """A point within the bounds; without them, around the lowest so far at a random width."""
    key, other = jax.random.split(key)
    n, dtype = params.theta.size, params.theta.dtype
    if params.low is not None and params.high is not None:
        share = jax.random.uniform(key, (n,), dtype)
        inside = params.low + share * (params.high - params.low)
    else:
        inside = jnp.full(n, jnp.inf, dtype)
    power = jax.random.uniform(other, (), dtype, -_WIDTHS, _WIDTHS)
    around = lowest + params.sigma * 2.0**power * jax.random.normal(key, (n,), dtype)
    return params.clip(jnp.where(jnp.isfinite(inside), inside, around))
