"""Calls whose faults come where they are made, on every device."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from smoothdiff._reraise import reraise


def awaited(f: Callable[..., Any], *args: Any) -> Any:
    """f(*args), waited for: a GPU returns before a black box under it has been called."""
    with reraise():
        return jax.block_until_ready(f(*map(jnp.asarray, args)))
