"""What must be a number, and what is made one."""

import operator
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array


def floating(x: ArrayLike) -> Array:
    """The array, in the default floating-point dtype unless it has one.

    Raises:
        TypeError: it is complex.
    """
    x = jnp.asarray(x)
    if jnp.iscomplexobj(x):
        raise TypeError(f"numbers of dtype {x.dtype} must be real")
    return x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(float)


def inexact(leaf: Any) -> Array:
    """The array, in the default floating-point dtype unless it has one or is complex."""
    leaf = jnp.asarray(leaf)
    # a dtype that is given is no weak type, for which everything would be compiled once more
    return leaf.astype(leaf.dtype if jnp.issubdtype(leaf.dtype, jnp.inexact) else float)


def at_least_float32(x: ArrayLike) -> Array:
    """The array, in float32 if it has a floating-point dtype of fewer bits.

    In float16 sums overflow and an eps of 1e-8 is zero, in bfloat16 a decay of 0.999 is one.
    """
    x = jnp.asarray(x)
    coarse = jnp.issubdtype(x.dtype, jnp.floating) and jnp.finfo(x.dtype).bits < 32
    return x.astype(jnp.float32) if coarse else x


def check_whole(value: Any, name: str) -> None:
    """Raises TypeError unless it is a whole number."""
    try:
        operator.index(value)
    except TypeError as error:
        raise TypeError(f"{name} must be a whole number, not {value!r}") from error


def check_real(value: Any, name: str) -> None:
    """Raises TypeError unless it is a real number or an array of them."""
    dtype = getattr(value, "dtype", None) or np.asarray(value).dtype
    if not (jnp.issubdtype(dtype, jnp.number) or jnp.issubdtype(dtype, jnp.bool_)):
        raise TypeError(f"{name} must be a real number or an array of them, not {value!r}")
    if jnp.issubdtype(dtype, jnp.complexfloating):
        raise TypeError(f"{name} = {value} is complex: it must be a real number")
