"""A look over the whole box of the bounds, before a search ends.

A search knows a neighbourhood. Where it ends in a minimum of little depth, a few points anywhere
are mostly lower; where it found a good one, they cost no more than a round of samples.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from smoothdiff._params import Params


def bounded(params: Params) -> bool:
    """Whether there are bounds to both sides, open or not."""
    return params.low is not None and params.high is not None


def bounds_of(params: Params) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Those of parameters that are `bounded`."""
    if params.low is None or params.high is None:
        raise ValueError("this goes from bound to bound: give bounds")
    return params.low, params.high


def closed(params: Params) -> Bool[Array, ""]:
    """Whether all of these bounds are finite."""
    return jnp.all(jnp.isfinite(jnp.stack(bounds_of(params))))


def length(n: int) -> int:
    """How many points a look takes: as many as a first quadratic model."""
    return 2 * n + 1


class Look(eqx.Module):
    """How many points were `taken`, and whether the look is `done`.

    `before` is the lowest value before it, and `follows` the stage that comes next if nothing is
    lower.
    """

    taken: Int[Array, ""]
    done: Bool[Array, ""]
    before: Float[Array, ""]
    follows: Int[Array, ""]

    @staticmethod
    def start(like: Float[Array, " n"]) -> "Look":
        """Nobody has looked."""
        none = jnp.zeros((), jnp.int32)
        return Look(none, jnp.asarray(False), jnp.asarray(jnp.inf, like.dtype), none)
