"""Earlier batches of a run, kept for later fits of a surrogate: importance weights for both."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


class Replay(eqx.Module):
    """The newest batches: points, values, shares in a mean, and log densities when drawn.

    A batch that is not there yet has no share.
    """

    u: Float[Array, "B N n"]
    values: Float[Array, "B N"]
    share: Float[Array, "B N"]
    log_density: Float[Array, "B N"]

    @staticmethod
    def start(batches: int, num_samples: int, like: Float[Array, " n"], dtype) -> "Replay":
        """Room for so many batches."""
        rows = jnp.zeros((batches, num_samples), like.dtype)
        points = jnp.zeros((batches, num_samples, like.size), like.dtype)
        return Replay(points, rows.astype(dtype), rows, rows)

    def after(
        self,
        step: Int[Array, ""],
        u: Float[Array, "N n"],
        values: Float[Array, " N"],
        share: Float[Array, " N"],
        log_density: Float[Array, " N"],
    ) -> "Replay":
        """With one more batch, in the place of the oldest."""
        at = step % len(self.u)
        return Replay(
            self.u.at[at].set(u),
            self.values.at[at].set(values),
            self.share.at[at].set(share),
            self.log_density.at[at].set(log_density),
        )

    def weights(self, log_density: Float[Array, "B N"]) -> Float[Array, "B N"]:
        """The weight of each sample in a mean under the present density; they sum to one.

        The density that drew it is behind the present one where that is larger, so a weight is at
        most a sample's share: a few samples that were unlikely must not outvote the newest batch.
        """
        ratio = jnp.exp(jnp.minimum(log_density - self.log_density, 0))
        weights = self.share * ratio
        return weights / jnp.sum(weights)
