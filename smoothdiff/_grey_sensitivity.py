"""How much a picture changes with each parameter: what an error of the network costs.

A parameter that is off by e changes the picture by s e^2, mean squared. Here s depends on the size
of e: where edges move a picture changes by about |e|. So s is measured where it is needed. Some
renders are made again with one parameter moved by as much as the network is usually off in it. The
mean squared difference of the two pictures, over e^2, is s.

A parameter counts as the root of its s, halfway between what pictures and what parameters say.
Where all count alike a network learns much that cannot be seen; where they count as s it neglects
those that are hard to learn and hardly seen, and is far off in them.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

# what earlier rounds count, relative to those after them: the network's errors become smaller
_MEMORY = 0.8
# so many pairs say that a parameter is like the others
_ALIKE = 2
# no parameter is less sensitive than this share of the mean
_LEAST = 0.01


class Moved(NamedTuple):
    """Parameters of which one is moved, which it is, and by how much, up to the sign."""

    points: Float[Array, "k n"]
    entry: Int[Array, " k"]
    distance: Float[Array, " k"]

    @staticmethod
    def of(key: Key[Array, ""], points: Float[Array, "k n"], said: Float[Array, "k n"]) -> "Moved":
        """Moves one entry of each point; `said` is the network's answer to its render, or NaN."""
        error = said - points
        usual = jnp.sqrt(jnp.nanmean(error**2, axis=0))
        k, n = points.shape
        # all parameters in turn, the first at random
        entry = (jnp.arange(k) + jax.random.randint(key, (), 0, n)) % n
        one = jax.nn.one_hot(entry, n, dtype=bool)
        moved = jnp.where(one, points + jnp.where(error < 0, -usual[None], usual[None]), points)
        return Moved(moved, entry, usual[entry])


class Sensitivity(eqx.Module):
    """What the pairs of all rounds say, for each parameter: a sum, and how many they are."""

    total: Float[Array, " n"]
    pairs: Float[Array, " n"]

    @staticmethod
    def start(point: Float[Array, " n"]) -> "Sensitivity":
        """No pair yet."""
        return Sensitivity(jnp.zeros_like(point), jnp.zeros_like(point))

    @eqx.filter_jit
    def after(self, moved: Moved, change: Float[Array, " k"]) -> "Sensitivity":
        """With these, and the mean squared change of each picture, NaN where nothing is known."""
        found = (change / moved.distance**2).astype(self.total.dtype)
        good = jnp.isfinite(found) & jnp.isfinite(moved.distance)
        add = lambda x: jnp.zeros_like(self.total).at[moved.entry].add(jnp.where(good, x, 0))
        return Sensitivity(_MEMORY * self.total + add(found), _MEMORY * self.pairs + add(1.0))

    @eqx.filter_jit
    def counts(self) -> Float[Array, " n"]:
        """How much each parameter counts: the root of its s, with a mean of one.

        All count alike while nothing is known.
        """
        pairs = jnp.sum(self.pairs)
        usual = jnp.sum(self.total) / jnp.where(pairs > 0, pairs, 1)
        usual = jnp.where(usual > 0, usual, 1)
        found = (self.total + _ALIKE * usual) / (self.pairs + _ALIKE)
        found = jnp.sqrt(jnp.maximum(found / jnp.mean(found), _LEAST))
        return found / jnp.mean(found)
