"""Where a search of Gauss-Newton stands: how it begins, and how it ends."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from smoothdiff._params import Params
from smoothdiff._solvers._fall import Fall
from smoothdiff._solvers._first_points import FirstPoints
from smoothdiff._solvers._history import History
from smoothdiff._solvers._looking_search import AbstractLookingSearch
from smoothdiff._solvers._pilot import Pilot
from smoothdiff._solvers._residual_trust import TrustRegion
from smoothdiff._solvers._stages import FIRST, WIDE, Sizes
from smoothdiff._solvers._turns import Turn
from smoothdiff._solvers._wide_rounds import Wide

# so much of the loss at the start is much, where a search should end
_MUCH = 0.1


class ResidualState(AbstractLookingSearch):
    """Where a search stands, with the local model and the wide one.

    A parameter `matters` that changed something at the first points.
    """

    trust: TrustRegion
    wide: Wide
    turn: Turn
    matters: Bool[Array, " n"]

    @classmethod
    def of(cls, theta: Float[Array, " n"], history: History) -> "ResidualState":
        """Nothing is known but what is in the history."""
        n, size = len(theta), history.rows.shape[1]
        one, none = jnp.ones((), theta.dtype), jnp.zeros((), jnp.int32)
        return cls(
            stage=jnp.asarray(FIRST, jnp.int32),
            history=history,
            start=theta,
            evaluated=none,
            first=FirstPoints.start(theta),
            trust=TrustRegion.start(one, n, size),
            wide=Wide.start(theta, jnp.zeros(size, theta.dtype), jnp.ones_like(theta)),
            turn=Turn.start(n, one),
            matters=jnp.zeros(n, bool),
            small=none,
            fall=Fall.start(one),
            pilot=Pilot.start(theta),
            average=None,
            look=None,
        )

    def again(
        self,
        params: Params,
        theta: Float[Array, " n"],
        start: Float[Array, " n"],
        lowest: tuple[Float[Array, " n"], Float[Array, ""]],
        key: Array,
    ) -> "ResidualState":
        """Another search, from elsewhere, with other random numbers."""
        empty = jax.tree.map(jnp.zeros_like, self.history)
        anew = self.of(theta, empty)
        anew = dataclasses.replace(anew, look=self.look)
        return eqx.tree_at(lambda s: s.wide.rounds, anew, self.wide.rounds + 1)

    def elsewhere(self, params: Params, theta: Float[Array, " n"]) -> "ResidualState":
        """Another search, with all that was evaluated."""
        anew = self.of(theta, self.history)
        anew = dataclasses.replace(anew, pilot=self.pilot, look=self.look)
        return anew.widened(params, theta, jnp.ones_like(theta[0]))

    def widened(
        self, params: Params, theta: Float[Array, " n"], width: Float[Array, ""]
    ) -> "ResidualState":
        """With longer steps along the parameters, from a point that is known."""
        first = self.first.around(self.history.best(theta)[2])
        first = dataclasses.replace(first, reach=width * first.reach)
        stage = jnp.full_like(self.stage, FIRST)
        return eqx.tree_at(lambda s: (s.stage, s.start, s.first), self, (stage, theta, first))

    def teaches(self) -> Bool[Array, ""]:
        """A look; a check that comes true says as much as a small step."""
        return self.is_looking()

    def level(self) -> Bool[Array, ""]:
        """Whether the local model's last step promised no more than rounding, and came to that."""
        return self.is_local() & self.trust.level

    def lost(self, sizes: Sizes) -> Bool[Array, ""]:
        """Whether it converged, or so many evaluations in a row were hardly lower."""
        return self.converged() | (self.fall.since >= sizes.patience)

    def is_good(self) -> Bool[Array, ""]:
        """Where little of the loss is left, no other minimum is much lower."""
        return ~self.much()

    def stands_still(self) -> Bool[Array, ""]:
        """Whether some parameter changes nothing here that did at the first points."""
        slopes = jnp.linalg.norm(self.trust.jacobian, axis=1)
        return jnp.any(self.matters & (slopes <= jnp.finfo(slopes.dtype).eps * jnp.max(slopes)))

    def much(self) -> Bool[Array, ""]:
        """Whether much of the loss at the start is left."""
        return self.history.best(self.start)[2] > _MUCH * self.first.before

    def round(self) -> Int[Array, ""]:
        """So many wide rounds."""
        return self.wide.rounds

    def numbers(self) -> Int[Array, ""]:
        """In rounds each sample has a key of its own, as its residuals are not compared."""
        return jnp.where(self.stage == WIDE, self.evaluated, 0)

    def smoothing(self) -> Float[Array, ""]:
        """Half the squares of what the linear model adds."""
        return jnp.sum((self.trust.jacobian * self.length()[:, None]) ** 2) / 2

    def length(self) -> Float[Array, " n"]:
        """The radius, or the width of the samples."""
        return jnp.where(self.stage == WIDE, self.wide.scale, self.trust.radius)

    def scaled(self, params: Params) -> Params:
        """With a smaller sigma where the first points said so."""
        return dataclasses.replace(params, sigma=params.sigma * self.first.reach)
