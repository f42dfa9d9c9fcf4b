"""One search for the minimum of one number: first points, a trust region, wide samples.

The function is evaluated at the start and one sigma from it to both sides of each parameter. Then
two models take turns. A local one, around the best point, needs one evaluation a step, and wins
where the function is smooth. The other is a regression over samples around a center that moves; it
wins where the function is rough. Whichever lowers the function faster goes on.
"""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from smoothdiff._params import Params
from smoothdiff._solvers._base import all_finite
from smoothdiff._solvers._box import turned_inside
from smoothdiff._solvers._fall import Fall, much
from smoothdiff._solvers._first_points import CARRIED, NEARER, FirstPoints, others_nearer
from smoothdiff._solvers._history import History
from smoothdiff._solvers._judgement import differ
from smoothdiff._solvers._parameter_scan import Scan
from smoothdiff._solvers._quadratic_trust import Proposal
from smoothdiff._solvers._ratio_test import are_level
from smoothdiff._solvers._stages import FIRST, SCAN, TRUST, WIDE, Sizes, by_stage
from smoothdiff._solvers._turns import Turn
from smoothdiff._solvers._value_state import SIDES, ValueState
from smoothdiff._solvers._where import where

# a first search is long after so many evaluations for each parameter, and one
_LONG = 60
# a turn of a local model that predicts is at most so many times as long
_LONGER = 4
# where it has a single one, it is so many times as long as a first one
_ONE_TURN = 2
# so many steps or evaluations that led nowhere are enough for any patience
_ENOUGH = 2**24


class ValueSearch(ValueState):
    """What is evaluated next, and what that teaches: two models in turns, and a scan."""

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
        nothing = self.trust.nothing(count)

        def first() -> tuple[Array, Proposal]:
            unit = jnp.eye(n, dtype=self.start.dtype)
            sides = jnp.stack([unit, -unit], axis=1).reshape(SIDES * n, n)
            points = self.first.points(sides, lambda: draw(count), count)
            far = self.near * self.width() * params.sigma
            return turned_inside(params, self.start, far[None] * points), nothing

        def local() -> tuple[Array, Proposal]:
            center, _, fun = self.history.best(self.start)
            proposal = self.trust.propose(self.history, center, fun, params, count, self.evaluated)
            return center[None] + self.trust.metric.out(proposal.points), proposal

        def wide() -> tuple[Array, Proposal]:
            z = draw(sizes.first)[jnp.minimum(self.taken + slot, sizes.first - 1)]
            points = jax.vmap(lambda z: self.center.sample(params, z))(z)
            best, *_ = self.history.best(self.start)
            return points.at[0].set(jnp.where(self.checks_noise(), best, points[0])), nothing

        further = lambda: (self.pilot.points(params, self.start, draw, count), nothing)
        branches = [first, local, wide, further]
        if (look := self.look) is not None:
            best = self.history.best(self.start)[0]
            # a scan that is to come goes along all axes
            axes = self.scan is None
            branches.append(lambda: (look.points(params, best, draw, count, axes), nothing))
        if (scan := self.scan) is not None and (bounds := params.bounds) is not None:
            branches.append(lambda: (scan.propose(*bounds, count), nothing))
        return by_stage(self.stage, stage, branches)

    def after(
        self,
        params: Params,
        new: History,
        proposal: Proposal,
        sizes: Sizes,
        stage: int | None = None,
    ) -> "ValueSearch":
        """The search with these new evaluations."""
        _, row, before = self.history.best(self.start)
        barred = new.barred(row, before, jnp.max(proposal.reduction), squares=False)
        new = where(self.is_local() & self.at_edge(), barred, new)
        known = self.kept(new)
        known = eqx.tree_at(lambda s: s.turn, known, self.turn.more(sizes.step))

        def fallen() -> Fall:
            if self.look is None or params.bounds is None:  # nobody asks
                return self.much
            fun = known.history.least()
            return self.much.after(fun, much(fun, known.history.usual()), sizes.step)

        def first() -> "ValueSearch":
            first = self.first.known(sizes.step)
            enough, determined = first.done(), first.determined()
            # a scan has said how far, and a retry, too: there reach is not one
            now = determined & ~self.first.determined() & jnp.all(self.first.reach == 1)
            near = self.near * others_nearer(jnp.where(now, known.nearer(), 1), determined)
            near = jnp.where(enough, 1, jnp.maximum(near, CARRIED))
            stage = jnp.where(enough, TRUST, FIRST).astype(self.stage.dtype)
            turn = Turn.start(len(self.start), known.history.best(self.start)[2])
            more = dataclasses.replace(known, first=first, near=near)
            over = eqx.tree_at(lambda s: (s.stage, s.turn), more, (stage, turn))
            over = where(enough, over.compared(), over).piloting(params)
            return where(enough, more.narrowed(params, over, sizes), over)

        def local() -> "ValueSearch":
            trust = self.trust.revise(proposal, before, new.funs, new.valid)
            slow = jnp.where(known.at_bottom(sizes, self.trust.radius), _ENOUGH, trust.slow)
            trust = eqx.tree_at(lambda t: t.slow, trust, slow)
            changed = trust, known.history.best(self.start)[0], fallen()
            after = eqx.tree_at(lambda s: (s.trust, s.place, s.much), known, changed)
            return after._turned(params, sizes)

        def wide() -> "ValueSearch":
            taken = self.taken + sizes.step
            noisy = self.noisy | (self.checks_noise() & new.valid[0] & differ(new.funs[0], before))
            changed = taken, noisy, fallen()
            more = eqx.tree_at(lambda s: (s.taken, s.noisy, s.much), known, changed)
            full = lambda: more._stepped(params, sizes)._turned(params, sizes)
            return jax.lax.cond(taken >= sizes.first, full, lambda: more)

        # neither model's turn
        apart = dataclasses.replace(known, turn=self.turn)
        branches = [first, local, wide, lambda: apart.piloted(params, new)]
        if self.look is not None:
            # the local model knows nothing of a place far away that is as good
            lower = dataclasses.replace(new, valid=new.valid & (new.funs != before))
            branches.append(lambda: self.kept(lower).after_look(params, sizes.step))
        if (scan := self.scan) is not None:
            funs = jnp.where(new.valid, new.funs, jnp.inf)
            branches.append(lambda: apart._scanned(params, scan.after(new.points, funs)))
        return by_stage(self.stage, stage, branches)

    def _scanned(self, params: Params, scan: Scan) -> "ValueSearch":
        """With this scan; the best places of all parameters together are where a search begins."""
        known = eqx.tree_at(lambda s: s.scan, self, scan)
        goes_on = scan.failed & (self.searches == 0)
        stage = jnp.where(goes_on, WIDE, self.stage).astype(self.stage.dtype)
        # what a scan is to find is no point that is lower
        new = stage, jnp.where(goes_on, 0, self.fall.since)
        known = eqx.tree_at(lambda s: (s.stage, s.fall.since), known, new)
        first = FirstPoints.start(scan.found, SIDES)
        first = dataclasses.replace(first, reach=scan.nearest / params.sigma)
        anew = known.anew(params, scan.found, first, jnp.ones_like(scan.fun))
        return where(scan.done(), anew, known)

    def _stepped(self, params: Params, sizes: Sizes) -> "ValueSearch":
        """The next center, from all samples."""
        history, average = self.history, self.average
        keyed, known = average is not None, (history.points, history.funs, history.valid)
        rounds = history.numbers if keyed else None
        returns = ~self.patient(self.searches) & ~self.noisy & (not keyed)
        level = are_level(*self.last(sizes))
        center, *_ = self.center.stepped(params, *known, True, returns, level, rounds=rounds)
        # a metric can overflow where the function is flat
        finite = all_finite((center.theta, center.metric, center.trust.width))
        center = where(finite, center, self.center)
        stall = jnp.where(
            self.at_bottom(sizes, self.center.trust.width), _ENOUGH, center.trust.stall
        )
        center = eqx.tree_at(lambda c: c.trust.stall, center, stall)
        # where no sample gave a number, the next ones are nearer to the best point
        nearer = NEARER * self.center.trust.width
        back = self.center.moved(history.best(self.start)[0], jnp.zeros_like(nearer))
        back = eqx.tree_at(lambda c: c.trust.width, back, nearer)
        center = where(jnp.any(self.last(sizes)[1]), center, back)
        new = center, jnp.zeros_like(self.taken), self.rounds + 1
        after = eqx.tree_at(lambda s: (s.center, s.taken, s.rounds), self, new)
        return after if average is None else after.with_mean(average.after(center.theta))

    def _turned(self, params: Params, sizes: Sizes) -> "ValueSearch":
        """The other model's turn, if this one's is over."""
        turn, local = self.turn, self.is_local()
        point, _, fun = self.history.best(self.start)
        lower, little = turn.lowered(fun)
        stuck = local & self.trust.stuck()
        over = turn.over()
        if self.average is not None:
            # values with other keys are not to be compared, nor is how fast they fell: wide samples
            # go on to the end, and the model of one key has one turn before them
            over = local & (turn.spent >= _ONE_TURN * turn.length)
        ended = (over | stuck | (~local & self.center.lost(sizes))) & ~self.later()
        # a model that predicts goes on, but not in a test of it, nor for ever
        going = self.trust.predicts() & ~turn.test & (turn.spent < _LONGER * turn.length) & ~stuck
        # so does one about to converge, but not once it has: other searches may follow
        ended &= ~(local & (going | (self.small > 0))) | self.converged()

        # what one has found the other begins with, unless it found little
        revive = ~local & ((lower & self.trust.stuck()) | self._left(point))
        revived = self.trust.revived(self.center.trust.width)
        trust = where(revive, revived, self.trust)
        trust = where(local, trust, trust.retried())
        move = local & ((lower & ~little) | (self.rounds == 0))
        # where the local model went far, wide samples are as wide as it is trusted there
        radius = jnp.where(lower, trust.radius, 0)
        center = where(move, self.center.moved(point, radius), self.center)
        done = trust.failed(), center.lost(sizes)
        ours, theirs = where(local, *done), where(local, *done[::-1])
        following, other = turn.next(fun, len(self.start), (ours, theirs), stuck)
        stage = jnp.where(local == other, WIDE, TRUST).astype(self.stage.dtype)
        new = stage, trust, center, following
        turned = eqx.tree_at(lambda s: (s.stage, s.trust, s.center, s.turn), self, new)
        after = where(ended, turned, self)
        return after if after.scan is None else after._tried(after.scan, params, point, fun)

    def _left(self, point: Float[Array, " n"]) -> Bool[Array, ""]:
        """Whether this point lies beyond the radius around where the local model was."""
        length = jnp.linalg.norm(self.trust.metric.into(point - self.place))
        return length > self.trust.radius

    def _tried(self, scan: Scan, params: Params, point: Array, fun: Array) -> "ValueSearch":
        """With the try of a scan next, if the first search is long and wide samples go on."""
        due = (self.searches == 0) & (self.stage == WIDE) & ~self.turn.test
        due &= self.evaluated >= _LONG * (len(self.start) + 1)
        tried, possible = scan.next(params, point, fun)
        due &= possible & ~scan.made()
        stage = jnp.where(due, SCAN, self.stage).astype(self.stage.dtype)
        scan = where(due, tried, scan)
        return eqx.tree_at(lambda s: (s.stage, s.scan), self, (stage, scan))
