"""A pytree whose scalars are in one array for each dtype, for programs that are called often.

Each array that goes into a program or comes out of it takes microseconds, and a state has dozens of
scalars.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from smoothdiff._flat import Flat
from smoothdiff._params import is_concrete


@jax.tree_util.register_pytree_node_class
class Packed:
    """The scalars by dtype, the other arrays, and the rest, which is known when compiling."""

    def __init__(self, scalars: tuple[Any, ...], flat: Flat, rest: tuple[Any, ...]) -> None:
        self.scalars, self.flat, self.rest = scalars, flat, rest

    @staticmethod
    def of(tree: PyTree) -> "Packed":
        """Of any pytree, whose other leaves are hashable."""
        leaves, treedef = jax.tree.flatten(tree)
        alike: dict[np.dtype, list[int]] = {}
        for i, leaf in enumerate(leaves):
            if _is_scalar(leaf):
                alike.setdefault(leaf.dtype, []).append(i)
        slots = tuple((dtype, tuple(at)) for dtype, at in alike.items())
        scalars = tuple(_joined([leaves[i] for i in at], dtype) for dtype, at in slots)
        flat = Flat.of([None if _is_scalar(leaf) else leaf for leaf in leaves])
        return Packed(scalars, flat, (treedef, slots))

    def tree(self) -> PyTree:
        """The pytree."""
        treedef, slots = self.rest
        leaves = self.flat.tree()
        for (_, at), scalars in zip(slots, self.scalars, strict=True):
            for k, i in enumerate(at):
                leaves[i] = scalars[k, ...]
        return treedef.unflatten(leaves)

    def on_host(self) -> "Packed":
        """The same with scalars of NumPy's, which are on no device."""
        return Packed(tuple(map(np.asarray, self.scalars)), self.flat, self.rest)

    def tree_flatten(self) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        """As JAX asks for it."""
        return (self.scalars, self.flat), self.rest

    @classmethod
    def tree_unflatten(cls, rest: tuple[Any, ...], parts: tuple[Any, ...]) -> "Packed":
        """As JAX asks for it."""
        scalars, flat = parts
        return cls(scalars, flat, rest)


def _is_scalar(leaf: Any) -> bool:
    """Whether it is a number or a boolean, and no random key."""
    if not eqx.is_array(leaf) or leaf.ndim > 0:
        return False
    return not jnp.issubdtype(leaf.dtype, jax.dtypes.extended)


def _joined(scalars: list[Any], dtype: np.dtype) -> Array | np.ndarray:
    """As one array, of NumPy's outside of programs."""
    return np.array(scalars, dtype) if all(map(is_concrete, scalars)) else jnp.stack(scalars)
