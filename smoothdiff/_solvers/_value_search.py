"""One search for the minimum of one number: first points, a trust region, wide samples.

The function is evaluated at the start and one sigma from it to both sides of each parameter. Then
two models take turns. A local one, around the best point, needs one evaluation a step, and wins
where the function is smooth. The other is a regression over samples around a center that moves; it
wins where the function is rough. Whichever lowers the function faster goes on.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from smoothdiff._params import Params
from smoothdiff._solvers._base import all_finite
from smoothdiff._solvers._history import History
from smoothdiff._solvers._judgement import differ
from smoothdiff._solvers._metric import Metric
from smoothdiff._solvers._point_search import (
    FIRST,
    TRUST,
    WIDE,
    AbstractPointSearch,
    Sizes,
    by_stage,
    nothing,
)
from smoothdiff._solvers._quadratic_trust import Proposal, QuadraticTrust
from smoothdiff._solvers._regression_step import Center

# evaluations for each parameter, and one, of a model's first turn, and of the other's test after it
_TURN, _TEST = 6, 4
# the other takes over if it lowers the function at this share of the rate: the later, the less
# there is to gain
_SHARE = 0.3
# of so many later searches one begins at the start
_PATIENT = 4
# the widths of later searches, in sigma, as powers of ten at random
_NARROWEST, _WIDEST = -1.5, 0.3


class Turn(eqx.Module):
    """Whose turn it is: `spent` evaluations of `length`, from the value `before`.

    In a test, `rate` is by how much the other model lowered the function for each evaluation, in a
    turn of `usual` length.
    """

    spent: Int[Array, ""]
    length: Int[Array, ""]
    usual: Int[Array, ""]
    before: Float[Array, ""]
    rate: Float[Array, ""]
    test: Bool[Array, ""]


class ValueSearch(AbstractPointSearch):
    """Where a search stands, with the local model and the center of the wide samples.

    Those after the first, which `searches` counts, are the wide model's alone, in turns a patient
    one at the start and some elsewhere. A patient one never goes back to the lowest sample: what is
    lowest by chance does not lead it away from where the smoothed function is low. Nor does any
    search where the function is `noisy`: where it gave another value for the same point, which the
    first round of samples begins with.
    """

    first_width: Float[Array, ""]
    searches: Int[Array, ""]
    noisy: Bool[Array, ""]
    trust: QuadraticTrust
    center: Center
    taken: Int[Array, ""]
    rounds: Int[Array, ""]
    turn: Turn

    @staticmethod
    def of(
        theta: Float[Array, " n"], sigma: Float[Array, " n"], width: Array, history: History
    ) -> "ValueSearch":
        """Nothing is known but what is in the history; the first samples are so wide."""
        none, n = jnp.zeros((), jnp.int32), len(theta)
        center = Center.start(theta, Metric.of(sigma, True))
        center = eqx.tree_at(lambda c: c.trust.width, center, width)
        length = jnp.asarray(_TURN * (n + 1), jnp.int32)
        never = jnp.zeros_like(width)
        return ValueSearch(
            stage=jnp.asarray(FIRST, jnp.int32),
            history=history,
            start=theta,
            evaluated=none,
            small=none,
            stale=none,
            first_width=width,
            searches=none,
            noisy=jnp.asarray(False),
            trust=QuadraticTrust.start(sigma, width),
            center=center,
            taken=none,
            rounds=none,
            turn=Turn(none, length, length, never, never, jnp.asarray(False)),
        )

    def again(
        self, params: Params, theta: Float[Array, " n"], start: Float[Array, " n"], key: Array
    ) -> "ValueSearch":
        """Another search: in turns a patient one at the start, and some elsewhere of any width."""
        empty = jax.tree.map(jnp.zeros_like, self.history)
        searches = self.searches + 1
        here = _patient(searches)
        power = jax.random.uniform(key, (), theta.dtype, _NARROWEST, _WIDEST)
        theta, width = jnp.where(here, start, theta), jnp.where(here, 1, 10**power)
        anew = ValueSearch.of(theta, params.sigma, width, empty)
        stage = jnp.full_like(self.stage, WIDE)
        changed = stage, self.rounds + 1, searches, self.noisy
        return eqx.tree_at(lambda s: (s.stage, s.rounds, s.searches, s.noisy), anew, changed)

    def settled(self) -> Bool[Array, ""]:
        """The local model's may be none."""
        return ~self.is_local() | self.trust.settled

    def over(self, sizes: Sizes) -> Bool[Array, ""]:
        """Whether neither model leads anywhere; after one converged the wide one may yet."""
        return _lost(self.center, sizes) & (self.trust.failed() | (self.searches > 0))

    def width(self) -> Float[Array, ""]:
        """The radius, or the width of the samples."""
        return jnp.where(self.stage == WIDE, self.center.trust.width, self.trust.radius)

    def candidates(self) -> list[Float[Array, " n"]]:
        """With noise, the lowest point owes much to luck, and the center little."""
        return [self.center.theta]

    def round(self) -> Int[Array, ""]:
        """So many rounds of samples."""
        return self.rounds

    def smoothing(self) -> Float[Array, ""]:
        """Half the trace of the model's Hessian."""
        return jnp.trace(self.trust.hessian) * self.width() ** 2 / 2

    def propose(
        self,
        params: Params,
        draw: Callable[[int], Float[Array, "k n"]],
        sizes: Sizes,
        stage: int | None = None,
    ) -> tuple[Float[Array, "K n"], Proposal]:
        """The first points, the end of a step, or the next samples of a round."""
        n, count = len(self.start), sizes.step
        slot = jnp.arange(count, dtype=jnp.int32)
        nothing = Proposal(
            steps=jnp.zeros((count, n), self.start.dtype),
            reduction=jnp.zeros(count, self.start.dtype),
            hessian=self.trust.hessian,
            poor=jnp.asarray(False),
        )

        def first() -> tuple[Array, Proposal]:
            unit = jnp.eye(n, dtype=self.start.dtype)
            sides = jnp.stack([unit, -unit], axis=1).reshape(2 * n, n)
            table = jnp.concatenate([0 * unit[:1], sides])
            if count > 1:
                table = jnp.concatenate([table, draw(count)])
            at = jnp.minimum(self.evaluated + slot, len(table) - 1)
            return self.start[None] + self.first_width * params.sigma[None] * table[at], nothing

        def local() -> tuple[Array, Proposal]:
            center, _, fun = self.history.best(self.start)
            proposal = self.trust.propose(self.history, center, fun, params, count)
            return center[None] + self.trust.metric.out(proposal.steps), proposal

        def wide() -> tuple[Array, Proposal]:
            z = draw(sizes.first)[jnp.minimum(self.taken + slot, sizes.first - 1)]
            points = jax.vmap(lambda z: self.center.sample(params, z))(z)
            best, *_ = self.history.best(self.start)
            return points.at[0].set(jnp.where(self._checks(), best, points[0])), nothing

        return by_stage(self.stage, stage, [first, local, wide])

    def after(
        self,
        params: Params,
        new: History,
        proposal: Proposal,
        sizes: Sizes,
        stage: int | None = None,
    ) -> "ValueSearch":
        """The search with these new evaluations."""
        before = self.history.best(self.start)[2]
        known = self.kept(new)
        known = eqx.tree_at(lambda s: s.turn.spent, known, self.turn.spent + sizes.step)

        def first() -> "ValueSearch":
            enough = self.evaluated + sizes.step > 2 * len(self.start)
            stage = jnp.where(enough, TRUST, FIRST).astype(self.stage.dtype)
            turn = jnp.zeros_like(self.turn.spent), known.history.best(self.start)[2]
            return eqx.tree_at(
                lambda s: (s.stage, s.turn.spent, s.turn.before), known, (stage, *turn)
            )

        def local() -> "ValueSearch":
            trust = self.trust.revise(proposal, before, new.funs, new.valid)
            return eqx.tree_at(lambda s: s.trust, known, trust)._turned(sizes)

        def wide() -> "ValueSearch":
            taken = self.taken + sizes.step
            noisy = self.noisy | (self._checks() & new.valid[0] & differ(new.funs[0], before))
            more = eqx.tree_at(lambda s: (s.taken, s.noisy), known, (taken, noisy))
            full = lambda: more._stepped(params)._turned(sizes)
            return jax.lax.cond(taken >= sizes.first, full, lambda: more)

        return by_stage(self.stage, stage, [first, local, wide])

    def _checks(self) -> Bool[Array, ""]:
        """Whether a point is evaluated again that was evaluated before."""
        return (self.rounds == 0) & (self.taken == 0)

    def _stepped(self, params: Params) -> "ValueSearch":
        """The next center, from all samples."""
        history, returns = self.history, ~_patient(self.searches) & ~self.noisy
        center, *_ = self.center.stepped(
            params, history.points, history.funs, history.valid, True, returns
        )
        # a metric can overflow where the function is flat
        finite = all_finite((center.theta, center.metric, center.trust.width))
        center = jax.tree.map(lambda a, b: jnp.where(finite, a, b), center, self.center)
        none = jnp.zeros_like(self.taken)
        new = center, none, self.rounds + 1
        return eqx.tree_at(lambda s: (s.center, s.taken, s.rounds), self, new)

    def _turned(self, sizes: Sizes) -> "ValueSearch":
        """The other model's turn, if this one's is over."""
        turn, local = self.turn, self.is_local()
        point, _, fun = self.history.best(self.start)
        rate = (turn.before - fun) / jnp.maximum(turn.spent, 1).astype(fun.dtype)
        lower = rate > 0
        stuck = local & self.trust.stuck()
        ended = (turn.spent >= turn.length) | stuck
        ended |= ~local & _lost(self.center, sizes)
        ended &= self.searches == 0

        # what one has found the other begins with, unless it found little
        little = turn.test & (rate <= _SHARE * turn.rate)
        revive = ~local & lower & self.trust.stuck()
        trust = jax.tree.map(
            lambda a, b: jnp.where(revive, a, b),
            self.trust.revived(self.center.trust.width),
            self.trust,
        )
        trust = jax.tree.map(lambda a, b: jnp.where(local, a, b), trust, trust.retried())
        move = local & ((lower & ~little) | (self.rounds == 0))
        center = jax.tree.map(
            lambda a, b: jnp.where(move, a, b), self.center.moved(point), self.center
        )
        done = jnp.stack([trust.failed(), _lost(center, sizes)])
        here = jnp.where(local, 0, 1)
        other = 1 - here
        wins = turn.test & (~little | done[other]) & ~stuck
        stays = wins & ~done[here]
        first = jnp.full_like(turn.usual, _TURN * (len(self.start) + 1))
        usual = jnp.where(turn.test, jnp.where(wins, first, 2 * turn.usual), turn.usual)
        follows = jnp.where(stays, here, other)
        skipped = done[follows]
        follows = jnp.where(skipped, 1 - follows, follows)
        # a local model that does not predict has lost, without a test of the other
        test = ~turn.test & ~skipped & ~stuck
        usual = jnp.where(skipped, first, usual)
        short = jnp.full_like(usual, _TEST * (len(self.start) + 1))
        after = Turn(
            spent=jnp.zeros_like(turn.spent),
            length=jnp.where(test, short, usual),
            usual=usual,
            before=fun,
            rate=rate,
            test=test,
        )
        stage = jnp.where(follows == 0, TRUST, WIDE).astype(self.stage.dtype)
        turned = eqx.tree_at(
            lambda s: (s.stage, s.trust, s.center, s.turn), self, (stage, trust, center, after)
        )
        return jax.tree.map(lambda a, b: jnp.where(ended, a, b), turned, self)


def _patient(searches: Int[Array, ""]) -> Bool[Array, ""]:
    """Whether the search with this number is a patient one."""
    return searches % _PATIENT == 1


def _lost(center: Center, sizes: Sizes) -> Bool[Array, ""]:
    """Whether rounds of wide samples led nowhere for too long, or have no width any more."""
    trust = center.trust
    return (trust.stall * sizes.first >= sizes.patience) | nothing(trust.width)
