"""What a search makes of noise: a mean of its centers, and samples far enough apart.

A search gives a function that takes random numbers the same ones while its local model lasts. That
ends at a minimum of these numbers alone, or after one turn. Rounds of samples with fresh ones
follow, until the run ends. The more rounds, the nearer is the mean of their centers.

After the first rounds residuals are evaluated next to the center as often as around it. Samples
around it say how residuals change, those next to it what they are there. Where residuals are
curved, the mean over the samples around it is something else.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from smoothdiff._products import dot
from smoothdiff._solvers._residual_batch import centred
from smoothdiff._solvers._where import where

# how strongly later centers count: as the power of their number
_LATER = 3.0
# the share of a step within the samples that is taken: much of it is noise
SHARE = 0.5
# the next samples are so many times as far apart, at most
_NEARER, _FARTHER = 0.25, 1.5


class Average(eqx.Module):
    r"""The mean of the centers so far, in which the center of round k has a weight of about $k^3$.

    So what was far away at the beginning is soon forgotten.

    Source: Shamir and Zhang 2013, polynomial-decay averaging.
    """

    mean: Float[Array, " n"]
    count: Float[Array, ""]

    @staticmethod
    def start(theta: Float[Array, " n"]) -> "Average":
        """Of no center."""
        return Average(theta, jnp.zeros((), theta.dtype))

    def after(self, center: Float[Array, " n"]) -> "Average":
        """With one more."""
        count = self.count + 1
        share = (_LATER + 1) / (_LATER + count)
        return Average(self.mean + share * (center - self.mean), count)

    def over(self, other: Float[Array, " n"]) -> Float[Array, " n"]:
        """The mean, or before there is one another point."""
        return jnp.where(self.count > 0, self.mean, other)


def apart(
    width: Float[Array, "..."], noise: Float[Array, ""], signal: Float[Array, ""]
) -> Float[Array, "..."]:
    """How wide the next samples are at least, relative to sigma.

    So wide that they differ by as much as the noise; at most one.

    Args:
        width: that of these samples.
        noise: the root of the variance that noise has.
        signal: the same of the function over these samples.
    """
    tiny = jnp.finfo(noise.dtype).tiny
    factor = jnp.clip(noise / jnp.maximum(signal, tiny), _NEARER, _FARTHER)
    return jnp.minimum(factor * width, 1)


def seen_from_center(
    u: Float[Array, "M n"],
    rows: Float[Array, "M P"],
    valid: Bool[Array, " M"],
    there: Bool[Array, " M"],
) -> tuple[Float[Array, "M n"], Float[Array, "M P"], Bool[Array, " M"]]:
    """Points and residuals moved, so that their means are those of the evaluations at the center.

    These are the ones that are `there`, or next to it. They count for that alone: otherwise their
    noise would be in the slopes too, and a product of the two is no zero in the mean.
    """
    others = valid & ~there
    count = jnp.maximum(jnp.sum(there), 1)
    share = there.astype(rows.dtype) / count.astype(rows.dtype)
    at, here = dot(share, u), dot(share, rows)
    moved = at[None] + centred(u, others), here[None] + centred(rows, others), others
    return where(jnp.any(there), moved, (u, rows, valid))
