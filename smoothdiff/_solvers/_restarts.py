"""Starting another search where one leads nowhere."""

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

Search = TypeVar("Search")


class Restarts(eqx.Module):
    """How many searches may still follow, where they begin, and what the best one saw.

    Searches that have just begun are wide. So that they are not compared with the end of others on
    that width, `width` is that of the lowest estimate so far, in whatever form the solver has it.
    """

    left: Int[Array, ""]
    theta: Float[Array, " n"]
    width: PyTree[Array]

    @staticmethod
    def start(count: int, theta: Float[Array, " n"], width: PyTree[Array]) -> "Restarts | None":
        """None if no search is to follow, so that nothing is kept for it."""
        return Restarts(jnp.asarray(count, jnp.int32), theta, width) if count else None

    def after(self, lowest: Bool[Array, ""], width: PyTree[Array]) -> "Restarts":
        """Remembers how wide the batch was, if its estimate is the lowest so far."""
        width = jax.tree.map(lambda a, b: jnp.where(lowest, a, b), width, self.width)
        return Restarts(self.left, self.theta, width)

    def next(
        self, over: Bool[Array, ""], search: Search, first: Search
    ) -> tuple[Bool[Array, ""], Search, "Restarts"]:
        """Whether another search begins as that is over, the one that goes on, and what is left."""
        again = over & (self.left > 0)
        search = jax.tree.map(lambda a, b: jnp.where(again, a, b), first, search)
        left = self.left - again.astype(self.left.dtype)
        return again, search, Restarts(left, self.theta, self.width)
