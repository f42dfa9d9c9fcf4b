"""Where the steps of a search point by point are computed: on a CPU, wherever its function is.

A step is hundreds of small operations. A GPU must be told of each, which takes longer than all of
them on a CPU, and so does compiling for it.
"""

import contextlib
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree


def default_platform() -> str:
    """That of the device where JAX puts new arrays."""
    return platform_of(_chosen())


def platform_of(device: Any) -> str:
    """That of a device, by itself or by its name; None stands for JAX's own choice."""
    return jax.default_backend() if device is None else getattr(device, "platform", device)


def is_moved(device: Any) -> bool:
    """Whether steps are on a CPU though the function runs elsewhere, on this device."""
    other = platform_of(device) != "cpu"
    return other and jax.process_count() == 1 and _cpu() is not None


def where_committed(tree: PyTree) -> Any:
    """The device that someone chose for these arrays, else the one where JAX puts new arrays."""
    return next(iter(_committed(tree)), _chosen())


def put_with(tree: PyTree, array: np.ndarray) -> jax.Array | np.ndarray:
    """The array, on the device that someone chose for those of the tree.

    Where there is none, or several share them out, it goes wherever it is wanted.
    """
    devices = _committed(tree)
    return jax.device_put(array, *devices) if len(devices) == 1 else array


def on_cpu() -> contextlib.AbstractContextManager:
    """Within this context new arrays are on a CPU, if JAX has one."""
    cpu = None if default_platform() == "cpu" else _cpu()
    return contextlib.nullcontext() if cpu is None else jax.default_device(cpu)


def computed_on_cpu(method: Callable) -> Callable:
    """The method with its new arrays on a CPU."""

    @functools.wraps(method)
    def on_a_cpu(*args: Any, **options: Any) -> Any:
        with on_cpu():
            return method(*args, **options)

    return on_a_cpu


def brought(tree: PyTree) -> PyTree:
    """The same with new arrays here, which go wherever they are wanted."""
    return jax.tree.map(_brought, tree)


def _brought(leaf: Any) -> Any:
    if not isinstance(leaf, jax.Array):
        return leaf
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        data = _brought(jax.random.key_data(leaf))
        return jax.random.wrap_key_data(data, impl=jax.random.key_impl(leaf))
    return jnp.asarray(np.asarray(leaf))


def _committed(tree: PyTree) -> set[Any]:
    """The devices of the first array that someone put where it is, or none."""
    for leaf in jax.tree.leaves(tree):
        if isinstance(leaf, jax.Array) and leaf.committed:
            return leaf.devices()
    return set()


def _chosen() -> Any:
    """The device that the user said new arrays are on, or its platform; None where nobody did."""
    return jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]


def _cpu() -> Any:
    try:
        return jax.local_devices(backend="cpu")[0]
    except RuntimeError:
        return None
