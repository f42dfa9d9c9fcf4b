"""The values of all outputs as the columns of one matrix, so that one solve serves all of them.

One solve rather than one for each output, as jaxlib 0.10.0 to 0.11.0 can hang on a CPU where a
program has several independent calls of LAPACK over a batch, as it has under `jax.vmap`.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from smoothdiff._products import dot


class Columns:
    """Outputs of N samples, less their level, as an array of N rows."""

    def __init__(self, values: PyTree, weights: Float[Array, " N"], counts: Float[Array, " N"]):
        """Takes the weights of the level, and for each row whether it counts (1 or 0)."""
        self._leaves, self._tree = jax.tree.flatten(values)
        flat = [leaf.reshape(len(weights), -1) for leaf in self._leaves]
        # the level first, or its rounding would be all that is left of small differences
        self._levels = [dot(weights.astype(v.dtype), v) for v in flat]
        parts = [
            (v - level[None]).astype(counts.dtype) * counts[:, None]
            for v, level in zip(flat, self._levels, strict=True)
        ]
        self._ends = [sum(part.shape[1] for part in parts[: i + 1]) for i in range(len(parts))]
        self.small: Float[Array, "N P"] = (
            parts[0] if len(parts) == 1 else jnp.concatenate(parts, axis=1)
        )

    def rows(self, columns: Float[Array, "M P"]) -> PyTree:
        """Columns as outputs of M samples."""
        return self._back(columns, lambda part, level: part)

    def with_level(self, columns: Float[Array, "M P"]) -> PyTree:
        """Likewise, with the level added to the first row."""
        return self._back(columns, lambda part, level: part.at[0].add(level))

    def _back(self, columns: Array, change: Callable[[Array, Array], Array]) -> PyTree:
        parts = jnp.split(columns, self._ends[:-1], axis=1)
        return self._tree.unflatten(
            [
                change(part.astype(v.dtype), level).reshape(len(columns), *v.shape[1:])
                for part, level, v in zip(parts, self._levels, self._leaves, strict=True)
            ]
        )
