"""One search of Newton-CG, from a start to where it leads nowhere."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from smoothdiff._solvers._metric import Metric
from smoothdiff._solvers._noisy_step import Trust


class Search(eqx.Module):
    """Where a search stands: the last accepted point, the samples that are kept, the trust."""

    accepted: Float[Array, " n"]
    points: Float[Array, "m n"]
    values: Float[Array, " m"]
    valid: Bool[Array, " m"]
    metric: Metric
    trust: Trust

    @staticmethod
    def start(theta: Float[Array, " n"], metric: Metric, kept: int) -> "Search":
        """Nothing is known, and the samples are as wide as sigma."""
        return Search(
            accepted=theta,
            points=jnp.broadcast_to(theta, (kept, theta.size)),
            values=jnp.zeros(kept, theta.dtype),
            valid=jnp.zeros(kept, bool),
            metric=metric,
            trust=Trust.start(theta.size, theta.dtype),
        )

    def keeping(
        self, points: Float[Array, "k n"], values: Float[Array, " k"], valid: Bool[Array, " k"]
    ) -> "Search":
        """With new samples instead of the oldest."""
        kept = (
            jnp.concatenate([old[len(new) :], new.astype(old.dtype)])
            for old, new in ((self.points, points), (self.values, values), (self.valid, valid))
        )
        return Search(self.accepted, *kept, metric=self.metric, trust=self.trust)

    def moved(self, accepted: Float[Array, " n"], metric: Metric, trust: Trust) -> "Search":
        """The same samples, seen from elsewhere."""
        return Search(accepted, self.points, self.values, self.valid, metric, trust)

    def done(self, patience: int) -> Bool[Array, ""]:
        """Whether so many steps in a row led nowhere."""
        return self.trust.quiet >= patience
