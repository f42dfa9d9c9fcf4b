"""The last evaluations: where they were made, what came, and which of them count."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from smoothdiff._products import dot

# a point takes the place of the iterate where that is so many times as high: of a little less the
# noise of the function may be the reason
_LOWER = 0.8
# numbers that differ by so many roundings are hardly told apart
_HARDLY = 64
# where there is no value, one is taken that is higher than the best by this share of a promise
_BARRED = 0.1
# the highest values may be beyond all measure: of those below, this quantile is a usual one
_USUAL = 0.75


def alike(rows: Float[Array, "M P"], row: Float[Array, " P"]) -> Bool[Array, " M"]:
    """Which rows are this one, to the last bit.

    By a sum of distances: where little is optimised, one of truth values takes five times as long.
    """
    ones = jnp.ones(rows.shape[1], rows.dtype)
    return dot(jnp.abs(rows - row[None]), ones) == 0


def hardly_differ(rows: Float[Array, "M P"], row: Float[Array, " P"]) -> Bool[Array, " M"]:
    """Which rows differ from this one so little that no slope can be told."""
    little = _HARDLY * jnp.finfo(row.dtype).eps * jnp.abs(row)
    beyond = jnp.maximum(jnp.abs(rows - row[None]) - little[None], 0)
    return dot(beyond, jnp.ones_like(row)) == 0


class History(eqx.Module):
    """Evaluations from the oldest to the newest; at first all of them are empty, and not `valid`.

    A row holds what the function returned, residuals or one value, and `funs` what is minimised.
    Where it had no value one may be `guessed`, see `barred`, which is valid to the models. What has
    the same of the `numbers` was evaluated with the same key, if the function takes one.
    """

    points: Float[Array, "M n"]
    rows: Float[Array, "M P"]
    funs: Float[Array, " M"]
    valid: Bool[Array, " M"]
    guessed: Bool[Array, " M"]
    numbers: Int[Array, " M"]

    @staticmethod
    def of(
        points: Float[Array, "M n"],
        rows: Float[Array, "M P"],
        funs: Float[Array, " M"],
        valid: Bool[Array, " M"],
        numbers: Int[Array, ""] | int = 0,
    ) -> "History":
        """Of evaluations, none of them guessed, all with these numbers."""
        same = jnp.full(valid.shape, numbers, jnp.int32)
        return History(points, rows, funs, valid, jnp.zeros(valid.shape, bool), same)

    @staticmethod
    def empty(length: int, n: int, size: int, dtype) -> "History":
        """Of so many evaluations at n parameters, with so many residuals each."""
        points, rows = jnp.zeros((length, n), dtype), jnp.zeros((length, size), dtype)
        return History.of(points, rows, jnp.zeros(length, dtype), jnp.zeros(length, bool))

    def after(
        self,
        points: Float[Array, "m n"],
        rows: Float[Array, "m P"],
        funs: Float[Array, " m"],
        valid: Bool[Array, " m"],
        count: Int[Array, ""],
    ) -> "History":
        """With the first `count` of these in place of as many of the oldest."""

        def latest(old: Array, new: Array) -> Array:
            return jax.lax.dynamic_slice_in_dim(jnp.concatenate([old, new]), count, len(old))

        return jax.tree.map(latest, self, History.of(points, rows, funs, valid))

    def alone(self, start: Float[Array, " n"]) -> tuple[Bool[Array, "M n"], Int[Array, ""]]:
        """Which evaluations are off the start in this parameter alone; the place of the start's."""
        moved = self.points != start[None]
        one = self.valid & (jnp.sum(moved, axis=1) == 1)
        return one[:, None] & moved, jnp.argmax(self.valid & ~jnp.any(moved, axis=1))

    def newest(self, count: int) -> tuple[Array, Array, Bool[Array, " count"]]:
        """The last points, their rows, and which of them are valid."""
        return self.points[-count:], self.rows[-count:], self.valid[-count:]

    def followed_by(self, new: "History", keeps_best: bool) -> "History":
        """With these in place of as many of the oldest, of which the best one may stay.

        One pass over what is kept: rows may be long.
        """
        count = len(new.funs)
        after = jax.tree.map(lambda old, new: jnp.concatenate([old[count:], new]), self, new)
        if not keeps_best or count >= len(self.funs):
            return after
        best = self._best()
        # where it is among the oldest, it takes the place of the next one
        place = jnp.maximum(best - count, 0)
        return jax.tree.map(lambda old, after: after.at[place].set(old[best]), self, after)

    def best(self, start: Float[Array, " n"]) -> tuple[Array, Array, Array]:
        """The lowest point, its row and its value; at first the start, and zeros.

        Of equals the newest.
        """
        i = self._best()
        known = jnp.any(self.valid)
        return jnp.where(known, self.points[i], start), self.rows[i], self.funs[i]

    def barred(
        self,
        row: Float[Array, " P"],
        fun: Float[Array, ""],
        promise: Float[Array, ""],
        squares: bool,
    ) -> "History":
        """With values also where there are none, higher than the best one by a share of a promise.

        So a model turns away from where the function has no value, and learns which ways are open.
        If only the radius shrank, steps would end near the edge, wherever they meet it.
        """
        high = fun + _BARRED * jnp.maximum(promise, 0)
        bars = ~self.valid & (high > fun) & jnp.isfinite(high)
        if squares:
            bars &= fun > 0
            rows = jnp.sqrt(high / jnp.where(bars, fun, 1))[:, None] * row[None]
        else:
            rows = high
        rows = jnp.where(bars[:, None], rows, self.rows)
        funs = jnp.where(bars, high, self.funs)
        return History(self.points, rows, funs, self.valid | bars, bars, self.numbers)

    def evaluated(self) -> Bool[Array, " M"]:
        """Which of them are what the function returned."""
        return self.valid & ~self.guessed

    def went_lower(self, other: "History") -> Bool[Array, ""]:
        """Whether the lowest value is lower than that of another history."""
        return self.least() < other.least()

    def least(self) -> Float[Array, ""]:
        """The lowest value, infinite where there is none."""
        return jnp.min(self._known())

    def usual(self) -> Float[Array, ""]:
        """A value as most places have it: the highest of three quarters."""
        return jnp.nanquantile(jnp.where(self.valid, self.funs, jnp.nan), _USUAL, method="lower")

    def _known(self) -> Float[Array, " M"]:
        return jnp.where(self.valid, self.funs, jnp.inf)

    def _best(self) -> Int[Array, ""]:
        funs = self._known()
        return len(funs) - 1 - jnp.argmin(funs[::-1])

    def lowest(
        self, point: Float[Array, " n"], row: Float[Array, " P"]
    ) -> tuple[Float[Array, " n"], Float[Array, " P"]]:
        """Where the sum of squares was smallest, and the residuals there.

        It is the given point, with its residuals `row`, unless those squares are clearly larger.
        """
        funs = self._known()
        i = jnp.argmin(funs)
        lower = 2 * funs[i] < _LOWER * jnp.sum(row**2)
        return jnp.where(lower, self.points[i], point), jnp.where(lower, self.rows[i], row)
