"""How a pytree of parameters lies in one vector."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree


@dataclass(frozen=True)
class Layout:
    """How the leaves of a pytree lie in one vector; leaves that are not smoothed stay outside."""

    treedef: Any
    shapes: tuple[tuple[int, ...], ...]
    dtypes: tuple[np.dtype, ...]
    smoothed: tuple[bool, ...]

    @property
    def dtype(self) -> np.dtype:
        """The widest dtype of the smoothed leaves, which the vector has."""
        kept = [d for d, s in zip(self.dtypes, self.smoothed, strict=True) if s]
        return max(kept, key=lambda d: jnp.finfo(d).bits)

    def vector(self, leaves: Sequence[Any]) -> Array:
        """One vector from one entry per leaf, each broadcast to the shape of its leaf."""
        parts = [
            # rounded to the leaf's own dtype first, so that what is at a bound stays at it
            jnp.broadcast_to(jnp.asarray(leaf).astype(dtype).astype(self.dtype), shape).reshape(-1)
            for leaf, shape, dtype, keep in zip(
                leaves, self.shapes, self.dtypes, self.smoothed, strict=True
            )
            if keep
        ]
        return parts[0] if len(parts) == 1 else jnp.concatenate(parts)

    def tree(self, x: Array | np.ndarray, free: Sequence[Any] = ()) -> PyTree:
        """The pytree whose smoothed leaves come from the last axis of `x`, the others from `free`.

        Axes of `x` before the last lead the shape of every smoothed leaf.
        """
        rest, leaves, start = iter(free), [], 0
        for shape, dtype, keep in zip(self.shapes, self.dtypes, self.smoothed, strict=True):
            if not keep:
                leaves.append(next(rest))
                continue
            stop = start + math.prod(shape)
            leaves.append(x[..., start:stop].reshape((*x.shape[:-1], *shape)).astype(dtype))
            start = stop
        return self.treedef.unflatten(leaves)

    def alike(self, x: Array) -> PyTree:
        """As `tree` where all leaves are smoothed, with each in the dtype of `x`."""
        return replace(self, dtypes=(x.dtype,) * len(self.dtypes)).tree(x)

    def check_vector(self, v: PyTree) -> None:
        """Raises an error if `v` is not like the parameters; nothing is broadcast."""
        leaves, treedef = jax.tree.flatten(v)
        if treedef != self.treedef or tuple(map(jnp.shape, leaves)) != self.shapes:
            raise ValueError(
                "v must have the structure and shapes of the parameters, "
                f"{self.treedef.unflatten(self.shapes)}, not {jax.tree.map(jnp.shape, v)}: "
                "smooth_hvp takes (key, x, v, *other_args), mv takes v"
            )
        for leaf, keep in zip(leaves, self.smoothed, strict=True):
            if keep and not jnp.issubdtype(dtype := jnp.asarray(leaf).dtype, jnp.inexact):
                raise TypeError(f"v has dtype {dtype}: pass numbers as jnp.asarray(v, float)")


def layout_of(y: PyTree[Array]) -> Layout:
    """That of parameters of which all are smoothed."""
    leaves, treedef = jax.tree.flatten(y)
    shapes, dtypes = tuple(x.shape for x in leaves), tuple(x.dtype for x in leaves)
    return Layout(treedef, shapes, dtypes, (True,) * len(leaves))


def vectors(points: PyTree[np.ndarray]) -> np.ndarray:
    """Stacked points as vectors, one in each row."""
    leaves = jax.tree.leaves(points)
    flat = [np.reshape(leaf, (len(leaf), math.prod(leaf.shape[1:]))) for leaf in leaves]
    return np.concatenate(flat, axis=1)
