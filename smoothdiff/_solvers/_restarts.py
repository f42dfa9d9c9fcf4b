"""Starting another search where one leads nowhere."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from smoothdiff._solvers._where import where


class Restarts(eqx.Module):
    """How many searches may still follow, where they begin, and what the best one saw.

    Searches that have just begun are wide. So that they are not compared with the end of others on
    that width, `kernel` is the width of the lowest estimate so far, in whatever form the solver has
    it.
    """

    left: Int[Array, ""]
    theta: Float[Array, " n"]
    kernel: PyTree[Array]

    @staticmethod
    def start(count: int, theta: Float[Array, " n"], kernel: PyTree[Array]) -> "Restarts | None":
        """None if no search is to follow, so that nothing is kept for it."""
        return Restarts(jnp.asarray(count, jnp.int32), theta, kernel) if count else None

    def after(self, lowest: Bool[Array, ""], kernel: PyTree[Array]) -> "Restarts":
        """Remembers how wide the batch was, if its estimate is the lowest so far."""
        return Restarts(self.left, self.theta, where(lowest, kernel, self.kernel))

    def next(
        self, over: Bool[Array, ""], going: PyTree[Array], first: PyTree[Array]
    ) -> tuple[PyTree[Array], "Restarts"]:
        """What goes on, or if that is `over` and there is another search, what it begins with."""
        again = over & (self.left > 0)
        left = self.left - again.astype(self.left.dtype)
        return where(again, first, going), Restarts(left, self.theta, self.kernel)
