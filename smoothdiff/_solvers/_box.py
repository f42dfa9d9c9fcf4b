"""The box of parameters that have bounds to both sides."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from smoothdiff._params import Params


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
