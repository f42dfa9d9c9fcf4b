"""The caller of the user's function: rows of what it returns at rows of parameters."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.sharding import NamedSharding
from jaxtyping import Array, Float, PyTree

from smoothdiff._layout import Layout, layout_of
from smoothdiff._sharding import columns_shared_out, shared_out


class Evaluator(eqx.Module):
    """The function with its arguments.

    It returns residuals, whose `squares` are minimised, or one number. With a `sharding` devices
    share out the points, and then keep a part of each row.
    """

    fn: Callable[[PyTree, Any], tuple[PyTree, PyTree]]
    args: PyTree
    layout: Layout = eqx.field(static=True)
    squares: bool = eqx.field(static=True)
    batch_size: int | None = eqx.field(static=True)
    sharding: NamedSharding | None = eqx.field(static=True, default=None)

    def __call__(self, points: Float[Array, "m n"]) -> tuple[Float[Array, "m P"], PyTree]:
        """The rows, and the aux of the first."""
        rows, aux = self.with_aux(points)
        return rows, jax.tree.map(lambda a: a[0], aux)

    def with_aux(self, points: Float[Array, "m n"]) -> tuple[Float[Array, "m P"], PyTree]:
        """The rows, and the aux of each."""

        def row(x: Array) -> tuple[Array, PyTree]:
            out, aux = self.fn(self.layout.tree(x), self.args)
            return row_of(out, x.dtype), aux

        if self.sharding is not None:
            rows, aux = jax.vmap(row)(shared_out(points, self.sharding))
            return columns_shared_out(rows, self.sharding), aux
        if self.batch_size is None:
            return jax.vmap(row)(points)
        return jax.lax.map(row, points, batch_size=self.batch_size)

    def funs(self, rows: Float[Array, "m P"]) -> Float[Array, " m"]:
        """What is minimised, of each row."""
        return objectives(rows, self.squares)

    def values(self, points: PyTree[Array]) -> Float[Array, " m"]:
        """What is minimised at stacked points."""
        vector = self.layout.vector
        rows, _ = self(jax.vmap(lambda y: vector(jax.tree.leaves(y)))(points))
        return self.funs(rows)


def called(fun: Callable[[PyTree, Any], Any], y: PyTree[Array], args: PyTree) -> PyTree[Array]:
    """What the user's function returns, as arrays; a single whole number as a float, as in `y`.

    A count is a loss as good as any. Arrays of whole numbers are not: their differences may wrap.
    """
    out = jax.tree.map(jnp.asarray, fun(y, args))
    leaves = jax.tree.leaves(out)
    if [leaf.shape for leaf in leaves] != [()] or not jnp.issubdtype(leaves[0].dtype, jnp.integer):
        return out
    return jax.tree.map(lambda a: a.astype(layout_of(y).dtype), out)


def row_of(out: PyTree[Array], dtype: Any) -> Float[Array, " P"]:
    """What the function returned, as a vector."""
    return jnp.concatenate([jnp.ravel(leaf).astype(dtype) for leaf in jax.tree.leaves(out)])


def objectives(rows: Float[Array, "m P"], squares: bool) -> Float[Array, " m"]:
    """What is minimised, of each row of residuals, of which the squares are, or of one value."""
    return half_squares(rows) if squares else rows[:, 0]


def half_squares(rows: Float[Array, "m P"]) -> Float[Array, " m"]:
    """What least squares minimises, of each row."""
    return jnp.sum(rows**2, axis=1) / 2
