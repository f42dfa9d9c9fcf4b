"""The first points of a search: the start, and one or two along each parameter.

Sigma may suit one parameter and be far too large for another. Where the points along a parameter
say nothing of the slope at the start, nearer ones take their place, and the parameter has so much
smaller steps from then on. Those that come after it begin nearer, too: bounds that are far too wide
for one parameter mostly are for others. Sigma may also be nothing for a parameter that begins at
zero but for rounding: a farther point follows.
"""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

# a loss so many times that at the start is far higher; linear residuals that are tried again at the
# length that is worked out below give at most four times that
_HIGH = 10.0
# at so many places a parameter is tried, to both sides of the start; where no value is finite it
# comes so much nearer, else at most so much
_PLACES, NEARER, _NEAREST = 2 * 4, 0.1, 1e-6
# where points are nothing beside others they are tried so many times farther
FARTHER = 100.0
# for what others told a parameter comes no nearer than this
CARRIED = 0.03
# so often a point that fails is evaluated before one that is nearer: it may have failed by chance,
# and a step that was made short for that takes many evaluations to grow again
_CALLS = 2


class FirstPoints(eqx.Module):
    """What is still to be evaluated: `left` counts the calls for the start and for each point.

    A point may have twice as many at each distance, for both sides; one side uses up those of both.

    There are as many points for each parameter, one after the other. `reach` is the length of the
    step along each parameter, in units of its sigma, which may have `turned` to the other side.
    `before` is the loss at the start, by which `after` tells what is high; with `known` a point has
    one call.
    """

    reach: Float[Array, " n"]
    turned: Bool[Array, " n"]
    left: Int[Array, " points"]
    before: Float[Array, ""]

    @staticmethod
    def start(theta: Float[Array, " n"], sides: int = 1) -> "FirstPoints":
        """Nothing has been evaluated; there are so many points for each parameter."""
        left = jnp.full(sides * len(theta) + 1, _PLACES * _CALLS, jnp.int32).at[0].set(_CALLS)
        turned = jnp.zeros_like(theta, bool)
        return FirstPoints(jnp.ones_like(theta), turned, left, jnp.asarray(jnp.inf, theta.dtype))

    def around(self, fun: Float[Array, ""]) -> "FirstPoints":
        """All parameters again, from a point with this loss."""
        left = jnp.full_like(self.left, _PLACES * _CALLS).at[0].set(0)
        return FirstPoints(self.reach, jnp.zeros_like(self.turned), left, fun)

    def again(self, which: Bool[Array, " n"], factor: float | Array) -> "FirstPoints":
        """These parameters once more, so many times as far away, all or each."""
        points = jnp.repeat(which, (len(self.left) - 1) // len(which))
        left = _CALLS * jnp.append(False, points).astype(self.left.dtype)
        reach = jnp.where(which, factor, 1) * self.reach
        return FirstPoints(reach, self.turned, left, self.before)

    def done(self) -> Bool[Array, ""]:
        """Whether no point is left."""
        return jnp.all(self.left == 0)

    def determined(self) -> Bool[Array, " n"]:
        """Parameters of which no point is left."""
        return self._all_have(0)

    def untried(self) -> Bool[Array, " n"]:
        """Parameters of which no point was evaluated."""
        return self._all_have(_PLACES * _CALLS)

    def _all_have(self, calls: int) -> Bool[Array, " n"]:
        return jnp.all(self.left[1:].reshape(len(self.reach), -1) == calls, axis=1)

    def next(self, count: int) -> tuple[Int[Array, " K"], Bool[Array, " K"]]:
        """Which points come next, 0 for the start, and which of these places are taken at all."""
        order = jnp.argsort(self.left == 0, stable=True)
        slot = jnp.arange(count, dtype=jnp.int32)
        at = order[jnp.minimum(slot, len(order) - 1)].astype(jnp.int32)
        return at, slot < jnp.sum(self.left > 0, dtype=jnp.int32)

    def points(
        self, directions: Float[Array, "m n"], others: Callable[[], Float[Array, "k n"]], count: int
    ) -> Float[Array, "K n"]:
        """The next points in units of the reach, from the start along these directions.

        If there are fewer, others take the places that are left.
        """
        at, taken = self.next(count)
        points = jnp.concatenate([jnp.zeros_like(directions[:1]), directions])[at]
        if count == 1:
            return points
        fill = others()
        slot = jnp.arange(count, dtype=jnp.int32)
        return jnp.where(taken[:, None], points, fill[slot % len(fill)])

    def known(self, count: int) -> "FirstPoints":
        """With the next so many points evaluated, whatever came of them."""
        at, taken = self.next(count)
        # an index beyond the end is dropped
        left = self.left.at[jnp.where(taken, at, len(self.left))].set(0, mode="drop")
        return dataclasses.replace(self, left=left)

    def after(self, funs: Float[Array, " K"], both: Bool[Array, " n"]) -> "FirstPoints":
        r"""With these losses, infinite where there is none; the bounds leave some `both` sides.

        Linear residuals r + t d have their lowest loss along d within |r| / |d|, which a loss far
        above that at the start tells: t = sqrt(loss at the start / loss).
        """
        at, taken = self.next(len(funs))
        start = taken & (at == 0)
        before = jnp.where(jnp.any(start), jnp.min(jnp.where(start, funs, jnp.inf)), self.before)
        finite, left = jnp.isfinite(funs), self.left[at]
        # `left` counts down through the calls at each distance: the last of these leaves a 1
        again = ~finite & (left % _CALLS != 1)
        # if the start failed too, nearer is no better
        high = ~(funs <= _HIGH * before) & jnp.isfinite(before) & (before > 0) & ~start & ~again
        # of a point that fails the other side comes before a nearer one
        was = self.turned[at - 1]
        rest = (left - 1) // _CALLS
        turns = high & ~finite & both[at - 1] & (rest > 0)
        across = turns & ~was
        # a nearer one takes up what the other side has left at this distance
        later = jnp.where(high, jnp.where(across, rest, rest // 2 * 2) * _CALLS, 0)
        tries = jnp.where(again, left - 1, later)
        nearer = jnp.sqrt(before / jnp.where(finite & high, funs, 1))
        nearer = jnp.where(finite, jnp.maximum(nearer, _NEAREST), NEARER)
        nearer = jnp.where(high & (tries > 0) & ~across, nearer, 1)
        along = jnp.where(taken & (at > 0), at - 1, len(self.reach))
        turned = self.turned.at[along].set(was ^ turns, mode="drop")
        left = self.left.at[jnp.where(taken, at, len(self.left))].set(tries, mode="drop")
        reach = self.reach.at[along].multiply(nearer, mode="drop")
        tried = FirstPoints(reach, turned, left, before)
        # what is not tried yet comes nearer with the others, by what their first try said
        said = jnp.where(finite & (self.left[at] == _PLACES * _CALLS), nearer, 1)
        said = jnp.ones_like(reach).at[along].multiply(said, mode="drop")
        untried = tried.untried()
        carried = jnp.maximum(reach * others_nearer(said, ~untried), jnp.minimum(reach, CARRIED))
        return dataclasses.replace(tried, reach=jnp.where(untried, carried, reach))


def others_nearer(said: Float[Array, " n"], tried: Bool[Array, " n"]) -> Float[Array, ""]:
    """How many times as far the points of parameters not tried yet should be; one or less.

    The product of what this returns, call by call, is the geometric mean of what was said.

    Args:
        said: how many times as far each parameter's points should have been; one, if it said
            nothing, or before this call.
        tried: which parameters have said something by now.
    """
    count = jnp.maximum(jnp.sum(tried, dtype=jnp.int32), 1).astype(said.dtype)
    return jnp.exp(jnp.sum(jnp.log(jnp.maximum(said, NEARER))) / count)
