"""One search of Gauss-Newton by batches, from a start to where it leads nowhere."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from smoothdiff._solvers._history import History

# so many small steps in a row count as convergence
_SMALL = 3


class BatchSearch(eqx.Module):
    """Where a search stands.

    `scale` is the width relative to sigma, `seen` says that the last samples were not all the same.
    `lowest` is the lowest estimate so far, `stale` counts the steps in a row that gave no lower
    one, and `small` those that were small. `move` is the last step.
    """

    scale: Float[Array, ""]
    history: History
    move: Float[Array, " n"]
    seen: Bool[Array, ""]
    lowest: Float[Array, ""]
    stale: Int[Array, ""]
    small: Int[Array, ""]

    @staticmethod
    def start(history: History) -> "BatchSearch":
        """Nothing is known but what is in the history, and samples are as wide as sigma."""
        one, none = jnp.ones((), history.points.dtype), jnp.zeros((), jnp.int32)
        still = jnp.zeros_like(history.points[0])
        return BatchSearch(one, history, still, jnp.asarray(False), jnp.inf * one, none, none)

    def after(
        self,
        scale: Float[Array, ""],
        history: History,
        move: Float[Array, " n"],
        seen: Bool[Array, ""],
        fun: Float[Array, ""],
        small: Bool[Array, ""],
    ) -> "BatchSearch":
        """After a step with the estimate `fun`."""
        return BatchSearch(
            scale,
            history,
            move,
            seen,
            jnp.minimum(self.lowest, fun),
            jnp.where(fun < self.lowest, 0, self.stale + 1),
            jnp.where(small, self.small + 1, 0),
        )

    def converged(self) -> Bool[Array, ""]:
        """Whether the last steps were small."""
        return self.small >= _SMALL

    def over(self, patience: int) -> Bool[Array, ""]:
        """Whether it converged, or `patience` steps in a row gave no lower estimate."""
        return self.converged() | (self.stale >= patience)
