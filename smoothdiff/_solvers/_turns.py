"""Two models that take turns, so that the one goes on that lowers the function faster."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

# evaluations for each parameter, and one, of a model's first turn, and of the other's test after it
_TURN, _TEST = 6, 4
# the other takes over if it lowers the function at this share of the rate: the later, the less
# there is to gain
_SHARE = 0.3


class Turn(eqx.Module):
    """Whose turn it is: `spent` evaluations, of `length` at least, from the value `before`.

    In a test, `rate` is by how much the other model lowered the function for each evaluation, in a
    turn of `usual` length or more.
    """

    spent: Int[Array, ""]
    length: Int[Array, ""]
    usual: Int[Array, ""]
    before: Float[Array, ""]
    rate: Float[Array, ""]
    test: Bool[Array, ""]

    @staticmethod
    def start(n: int, before: Float[Array, ""]) -> "Turn":
        """The first turn, with n parameters."""
        none, length = jnp.zeros((), jnp.int32), jnp.asarray(_TURN * (n + 1), jnp.int32)
        return Turn(none, length, length, before, jnp.zeros_like(before), jnp.asarray(False))

    def more(self, count: int) -> "Turn":
        """With so many evaluations more."""
        return eqx.tree_at(lambda t: t.spent, self, self.spent + count)

    def over(self) -> Bool[Array, ""]:
        """Whether all evaluations of this turn are spent."""
        return self.spent >= self.length

    def lowered(self, fun: Float[Array, ""]) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
        """Whether the function fell to this value in the turn, and whether in a test too little."""
        rate = self._rate(fun)
        return rate > 0, self.test & (rate <= _SHARE * self.rate)

    def _rate(self, fun: Array) -> Array:
        return (self.before - fun) / jnp.maximum(self.spent, 1).astype(fun.dtype)

    def next(
        self,
        fun: Float[Array, ""],
        n: int,
        done: tuple[Bool[Array, ""], Bool[Array, ""]],
        stuck: Bool[Array, ""],
    ) -> tuple["Turn", Bool[Array, ""]]:
        """The turn after this one, and whether the other model has it.

        Args:
            fun: The lowest value so far.
            n: The number of parameters.
            done: Whether this model leads nowhere any more, and whether the other one does.
            stuck: This model does not predict: it has lost, without a test of the other.
        """
        _, little = self.lowered(fun)
        wins = self.test & (~little | done[1]) & ~stuck
        stays = wins & ~done[0]
        skipped = jnp.where(stays, done[0], done[1])
        other = stays == skipped
        first = jnp.full_like(self.usual, _TURN * (n + 1))
        usual = jnp.where(self.test, jnp.where(wins, first, 2 * self.usual), self.usual)
        usual = jnp.where(skipped, first, usual)
        test = ~self.test & ~skipped & ~stuck
        length = jnp.where(test, jnp.full_like(usual, _TEST * (n + 1)), usual)
        spent = jnp.zeros_like(self.spent)
        return Turn(spent, length, usual, fun, self._rate(fun), test), other
