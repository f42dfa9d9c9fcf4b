"""A look over the whole box of the bounds, before a search ends.

A search knows a neighbourhood. Where it ends in a minimum of little depth, a few points anywhere
are mostly lower; where it found a good one, they cost no more than a first quadratic model.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from smoothdiff._params import Params
from smoothdiff._solvers._box import bounds_of

# the seeds of the samples of a search are so many: each look and each search after one has others
_SEEDS = 2**16


class Look(eqx.Module):
    """How many points were `taken`, and whether the look is `done`.

    `before` is the lowest value before it, and `follows` the stage that comes next if nothing is
    lower. `found` counts the looks that found something lower.
    """

    taken: Int[Array, ""]
    done: Bool[Array, ""]
    before: Float[Array, ""]
    follows: Int[Array, ""]
    found: Int[Array, ""]

    @staticmethod
    def start(like: Float[Array, " n"]) -> "Look":
        """Nobody has looked."""
        none = jnp.zeros((), jnp.int32)
        return Look(none, jnp.asarray(False), jnp.asarray(jnp.inf, like.dtype), none, none)

    @staticmethod
    def length(n: int) -> int:
        """How many points it takes, of n parameters: as many as a first quadratic model."""
        return 2 * n + 1

    def begun(self, before: Float[Array, ""], follows: Int[Array, ""]) -> "Look":
        """Before its first point."""
        return Look(jnp.zeros_like(self.taken), self.done, before, follows, self.found)

    def more(self, count: int, n: int) -> "Look":
        """With so many points, of n parameters."""
        taken = self.taken + count
        changed = taken, self.done | (taken >= self.length(n))
        return eqx.tree_at(lambda k: (k.taken, k.done), self, changed)

    def again(self) -> "Look":
        """To come, after one that found something lower."""
        changed = jnp.zeros_like(self.done), self.found + 1
        return eqx.tree_at(lambda k: (k.done, k.found), self, changed)

    def points(self, params: Params, z: Float[Array, "k n"], count: int) -> Float[Array, "K n"]:
        """The next points, as evenly spread over the box as these normal ones over space."""
        low, high = bounds_of(params)
        at = self.taken + jnp.arange(count, dtype=jnp.int32)
        share = jax.scipy.special.ndtr(z)[jnp.minimum(at, len(z) - 1)]
        return low[None] + share * (high - low)[None]

    def seed(self, looking: Bool[Array, ""]) -> Int[Array, ""]:
        """What is added to those of a search's samples."""
        return _SEEDS * (2 * self.found + looking.astype(self.found.dtype))
