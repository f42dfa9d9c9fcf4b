"""A pytree as a tuple of its arrays, which JAX takes apart in a fraction of the time.

Taking modules apart and putting them together again costs milliseconds for a state of a hundred
arrays, each time that it goes into a program or comes out of it.
"""

from typing import Any

import equinox as eqx
import jax
from jaxtyping import PyTree


@jax.tree_util.register_pytree_node_class
class Flat:
    """The arrays of a pytree, and the rest, which is hashable and known when compiling."""

    def __init__(self, arrays: tuple[Any, ...], rest: tuple[Any, ...]) -> None:
        self.arrays, self.rest = arrays, rest

    @staticmethod
    def of(tree: PyTree) -> "Flat":
        """Of any pytree, whose other leaves are hashable."""
        leaves, treedef = jax.tree.flatten(tree)
        pairs = [(leaf, None) if eqx.is_array(leaf) else (None, leaf) for leaf in leaves]
        arrays, others = zip(*pairs, strict=True) if pairs else ((), ())
        return Flat(arrays, (treedef, others))

    def tree(self) -> PyTree:
        """The pytree."""
        treedef, others = self.rest
        pairs = zip(self.arrays, others, strict=True)
        return treedef.unflatten([b if a is None else a for a, b in pairs])

    def tree_flatten(self) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        """As JAX asks for it."""
        return self.arrays, self.rest

    @classmethod
    def tree_unflatten(cls, rest: tuple[Any, ...], arrays: tuple[Any, ...]) -> "Flat":
        """As JAX asks for it."""
        return cls(tuple(arrays), rest)
