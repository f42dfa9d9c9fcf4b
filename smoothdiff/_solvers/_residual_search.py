"""One search of Gauss-Newton, from a start to where it leads nowhere."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from smoothdiff._solvers._residual_history import History

# sigma follows twice the standard error of the step, at most so much smaller or larger at a time
_SHRINK, _GROW = 0.25, 1.5
# ... and no wider than so many times what the user gave, unless all samples are the same
_WIDEST = 2.0
# a step is tried so many times as far, where that is at least sigma
_FURTHER = 5.0
# so many small steps in a row count as convergence
_SMALL = 3


class ResidualSearch(eqx.Module):
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
    def start(history: History) -> "ResidualSearch":
        """Nothing is known but what is in the history, and samples are as wide as sigma."""
        one, none = jnp.ones((), history.points.dtype), jnp.zeros((), jnp.int32)
        still = jnp.zeros_like(history.points[0])
        return ResidualSearch(one, history, still, jnp.asarray(False), jnp.inf * one, none, none)

    def after(
        self,
        scale: Float[Array, ""],
        history: History,
        move: Float[Array, " n"],
        seen: Bool[Array, ""],
        fun: Float[Array, ""],
        small: Bool[Array, ""],
    ) -> "ResidualSearch":
        """After a step with the estimate `fun`."""
        return ResidualSearch(
            scale,
            history,
            move,
            seen,
            jnp.minimum(self.lowest, fun),
            jnp.where(fun < self.lowest, 0, self.stale + 1),
            jnp.where(small, self.small + 1, 0),
        )

    def further(self, sigma: Float[Array, " n"]) -> tuple[Float[Array, " n"], Bool[Array, ""]]:
        """A step on in the direction of the last one, and whether it is worth an evaluation."""
        step = _FURTHER * self.move
        return step, jnp.mean((step / sigma) ** 2) > 1

    def converged(self) -> Bool[Array, ""]:
        """Whether the last steps were small."""
        return self.small >= _SMALL

    def over(self, patience: int) -> Bool[Array, ""]:
        """Whether it converged, or `patience` steps in a row gave no lower estimate."""
        return self.converged() | (self.stale >= patience)


def next_scale(
    scale: Float[Array, ""],
    flat: Bool[Array, ""],
    history: History,
    here: Float[Array, " P"],
    u: Float[Array, "M n"],
    error: Float[Array, " n"],
    length: Float[Array, ""],
) -> Float[Array, ""]:
    """How wide the next batch is, relative to sigma.

    Args:
        scale: That of this batch.
        flat: The whole batch is the same; then the next one is twice as wide.
        history: All samples, this batch included.
        here: The residuals where the step starts, at the iterate or a better point.
        u: The points of the history as seen from there.
        error: The standard error of the step.
        length: Of the step.
    """
    # a plateau of the residuals around the iterate is seen whole or not at all
    plateau = history.valid & jnp.all(history.residuals == here[None], axis=1)
    extent = jnp.max(jnp.where(plateau, jnp.sqrt(jnp.mean(u**2, axis=1)), 0))
    wanted = jnp.maximum(2 * jnp.sqrt(jnp.mean(error**2)), length)
    wanted = jnp.clip(jnp.maximum(wanted, extent), _SHRINK, _GROW)
    return jnp.where(flat, 2 * scale, jnp.minimum(wanted * scale, _WIDEST))
