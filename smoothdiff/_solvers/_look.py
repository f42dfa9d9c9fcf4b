"""A look over the whole box of the bounds, or further on, where a search has little left to do.

A search knows a neighbourhood. Where it is in a minimum of little depth, a few points anywhere
are mostly lower; where it found a good one, they cost little. The last of them differ from the best
point in one parameter each: one that jumps may be wrong where the others are so right that no point
anywhere is lower. With few parameters there are some more, as these soon see most of the box.

Where there is no box a search may run off. So far from the start that steps beside the distance are
small, and differences of values are rounding, it seems to have converged. A point twice as far away
tells.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from smoothdiff._params import Params
from smoothdiff._solvers._box import has_box, over_box

# the seeds of the samples of a search are so many: each look and each search after one has others
_SEEDS = 2**16
# a search that goes so many sigmas has run off, or began with far too few: its end may be rounding
_FAR = 1e5
# of few parameters so many points are spread over the box
_FEWEST = 7


class Look(eqx.Module):
    """How many points were `taken`, and whether the look is `done`.

    `before` is the lowest value before it, and `follows` the stage that comes next if nothing is
    lower. `found` counts the looks after which the search began anew. The run began at the
    `origin`.
    """

    origin: Float[Array, " n"]
    taken: Int[Array, ""]
    done: Bool[Array, ""]
    before: Float[Array, ""]
    follows: Int[Array, ""]
    found: Int[Array, ""]

    @staticmethod
    def start(like: Float[Array, " n"]) -> "Look":
        """Nobody has looked."""
        none = jnp.zeros((), jnp.int32)
        return Look(like, none, jnp.asarray(False), jnp.asarray(jnp.inf, like.dtype), none, none)

    @staticmethod
    def length(n: int) -> int:
        """How many points a box takes, of n parameters."""
        return n + Look.spread(n)

    @staticmethod
    def spread(n: int) -> int:
        """How many of them are spread over all of it."""
        return max(n + 1, _FEWEST)

    def is_far(self, params: Params, point: Float[Array, " n"]) -> Bool[Array, ""]:
        """Whether a search may have run off to this point."""
        return ~has_box(params) & (self._distance(params, point) > _FAR)

    def reach(self, params: Params, point: Float[Array, " n"]) -> Float[Array, ""]:
        """How far the first points of a search at this point are from it, in sigmas."""
        half = self._distance(params, point) / 2
        return jnp.where(has_box(params), jnp.ones_like(half), half)

    def _distance(self, params: Params, point: Float[Array, " n"]) -> Float[Array, ""]:
        return jnp.max(jnp.abs(point - self.origin) / params.sigma)

    def begun(self, before: Float[Array, ""], follows: Int[Array, ""]) -> "Look":
        """Before its first point."""
        none = jnp.zeros_like(self.taken)
        return Look(self.origin, none, self.done, before, follows, self.found)

    def more(self, params: Params, count: int) -> "Look":
        """With so many points."""
        taken = self.taken + count
        enough = jnp.where(has_box(params), self.length(len(self.origin)), 1)
        changed = taken, self.done | (taken >= enough)
        return eqx.tree_at(lambda k: (k.taken, k.done), self, changed)

    def again(self) -> "Look":
        """To come, in a search that begins anew."""
        changed = jnp.zeros_like(self.done), self.found + 1
        return eqx.tree_at(lambda k: (k.done, k.found), self, changed)

    def points(
        self,
        params: Params,
        best: Float[Array, " n"],
        draw: Callable[[int], Float[Array, "k n"]],
        count: int,
        axes: bool = True,
    ) -> Float[Array, "K n"]:
        """The next points: as evenly spread over the box as normal ones over space.

        The last n change one parameter of the best point each if `axes`. Without a box all are
        beyond the best one, as seen from the start.
        """
        n = len(best)
        at = self.taken + jnp.arange(count, dtype=jnp.int32)
        times = (1 + at).astype(best.dtype)[:, None]
        further = best[None] + times * (best - self.origin)[None]
        points = over_box(params, lambda: draw(self.length(n)), at, further)
        first = self.spread(n)
        along = jax.nn.one_hot(jnp.minimum(at - first, n - 1), n, dtype=bool)
        others = has_box(params) & axes & (at >= first)[:, None] & ~along
        return jnp.where(others, best[None], points)

    def seed(self, looking: Bool[Array, ""]) -> Int[Array, ""]:
        """What is added to those of a search's samples."""
        return _SEEDS * (2 * self.found + looking.astype(self.found.dtype))
