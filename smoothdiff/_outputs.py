"""What a host function returns: as `out` promises, or as its first call has shown."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree


@dataclasses.dataclass(frozen=True)
class Outputs:
    """The structure, shapes and dtypes of the result for one sample."""

    tree: Any
    specs: tuple[jax.ShapeDtypeStruct, ...]

    @staticmethod
    def like(out: PyTree) -> "Outputs":
        """As an example, or as a pytree of ShapeDtypeStruct."""
        specs, tree = jax.tree.flatten(jax.tree.map(_spec, out))
        if not specs:
            raise TypeError(
                "`out` has no arrays in it; for a number write "
                "out=jax.ShapeDtypeStruct((), jnp.float32)"
            )
        return Outputs(tree, tuple(specs))

    def of_one(self) -> "Outputs":
        """These are of a batch of one sample: without its axis."""
        for spec in self.specs:
            if spec.shape[:1] != (1,):
                raise ValueError(
                    f"shape {spec.shape} for a batch of one sample: with batched=True all that is "
                    "returned must begin with the axis of the batch, here of size 1"
                )
        one = (jax.ShapeDtypeStruct(spec.shape[1:], spec.dtype) for spec in self.specs)
        return Outputs(self.tree, tuple(one))

    def shapes(self) -> tuple[jax.ShapeDtypeStruct, ...]:
        """As JAX has them now: 64-bit types are narrowed where they are switched off."""
        return tuple(
            jax.ShapeDtypeStruct(spec.shape, jax.dtypes.canonicalize_dtype(spec.dtype))
            for spec in self.specs
        )

    def have_nan(self) -> bool:
        """Whether each can hold a NaN."""
        return all(jnp.issubdtype(spec.dtype, jnp.inexact) for spec in self.specs)


def _spec(leaf: Any) -> jax.ShapeDtypeStruct:
    """The shape and type of an output, from a ShapeDtypeStruct or an example."""
    if not isinstance(leaf, jax.ShapeDtypeStruct | jax.Array):
        leaf = np.asarray(leaf)
    if not (jnp.issubdtype(leaf.dtype, jnp.number) or leaf.dtype == np.bool_):
        raise TypeError(
            "`out` must be a jax.ShapeDtypeStruct, an example array or number, or a pytree of "
            f"them; one of its leaves is {leaf!r}"
        )
    return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype)
