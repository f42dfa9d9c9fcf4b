"""The last evaluations of residuals: where they were made, what came, and which of them count."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

# a point takes the place of the iterate where its sum of squares is so many times as large: of a
# little less the noise of the function may be the reason
_LOWER = 0.8


class History(eqx.Module):
    """Rows from the oldest to the newest; at first all of them are empty, and not `valid`."""

    points: Float[Array, "M n"]
    residuals: Float[Array, "M P"]
    valid: Bool[Array, " M"]

    @staticmethod
    def empty(length: int, n: int, size: int, dtype) -> "History":
        """Of so many evaluations at n parameters, with so many residuals each."""
        return History(
            jnp.zeros((length, n), dtype), jnp.zeros((length, size), dtype), jnp.zeros(length, bool)
        )

    def after(
        self,
        points: Float[Array, "m n"],
        residuals: Float[Array, "m P"],
        valid: Bool[Array, " m"],
        count: Int[Array, ""],
    ) -> "History":
        """With the first `count` of these rows in place of as many of the oldest."""

        def latest(old: Array, new: Array) -> Array:
            return jax.lax.dynamic_slice_in_dim(jnp.concatenate([old, new]), count, len(old))

        new = History(points, residuals, valid)
        return jax.tree.map(latest, self, new)

    def keeping_best(self, count: int) -> "History":
        """The best row is not among the `count` oldest, which come to make way."""
        best = self._best()
        place = jnp.where(best < count, count, best) % len(self.valid)
        return jax.tree.map(lambda a: a.at[place].set(a[best]), self)

    def best(self, start: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, " P"]]:
        """The point with the smallest sum of squares, and its row; at first the start, and zeros.

        Of equals the newest.
        """
        i = self._best()
        known = jnp.any(self.valid)
        return jnp.where(known, self.points[i], start), self.residuals[i]

    def mostly_valid(self, count: int) -> Bool[Array, ""]:
        """Whether at least half of the last so many are valid."""
        return 2 * jnp.sum(self.valid[-count:]) >= count

    def _best(self) -> Int[Array, ""]:
        squares = jnp.where(self.valid, jnp.sum(self.residuals**2, axis=1), jnp.inf)
        return len(squares) - 1 - jnp.argmin(squares[::-1])

    def lowest(
        self, point: Float[Array, " n"], row: Float[Array, " P"]
    ) -> tuple[Float[Array, " n"], Float[Array, " P"]]:
        """Where the sum of squares was smallest, and the residuals there.

        It is the given point, with its residuals `row`, unless those squares are clearly larger.
        """
        squares = jnp.where(self.valid, jnp.sum(self.residuals**2, axis=1), jnp.inf)
        i = jnp.argmin(squares)
        lower = squares[i] < _LOWER * jnp.sum(row**2)
        return jnp.where(lower, self.points[i], point), jnp.where(lower, self.residuals[i], row)
