"""One search of Gauss-Newton with few parameters: first points, a trust region, wide regressions.

The function is evaluated at the start and one sigma from it along each parameter, or nearer where
that is far too long. Then a model of the residuals around the best point says where to evaluate
next, while it predicts what comes. Where its steps fail in a row, or most residuals do not move, a
wide regression takes over: rounds of samples around a center, which may go uphill, until its steps
come true or have led to nothing. While they lead to something, the local model is tested now and
then, and stays if it is about as fast.
"""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from smoothdiff._params import Params
from smoothdiff._solvers._fall import Fall
from smoothdiff._solvers._first_points import FARTHER, FirstPoints
from smoothdiff._solvers._history import History, alike
from smoothdiff._solvers._pilot import Pilot
from smoothdiff._solvers._point_search import AbstractPointSearch
from smoothdiff._solvers._residual_trust import Proposal, TrustRegion
from smoothdiff._solvers._stages import FIRST, TRUST, WIDE, Sizes, by_stage
from smoothdiff._solvers._turns import Turn
from smoothdiff._solvers._where import where
from smoothdiff._solvers._wide_rounds import Wide, further, sides_of

# around a lower point that wide rounds found the local model has a radius of so many widths
_NARROWER = 0.1
# so much of the loss at the start is much, where a search should end
_MUCH = 0.1


class ResidualSearch(AbstractPointSearch):
    """Where a search stands, with the local model and the wide one.

    A parameter `matters` that changed something at the first points.
    """

    trust: TrustRegion
    wide: Wide
    turn: Turn
    matters: Bool[Array, " n"]

    @classmethod
    def of(cls, theta: Float[Array, " n"], history: History) -> "ResidualSearch":
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
    ) -> "ResidualSearch":
        """Another search, from elsewhere, with other random numbers."""
        empty = jax.tree.map(jnp.zeros_like, self.history)
        anew = self.of(theta, empty)
        anew = dataclasses.replace(anew, look=self.look)
        return eqx.tree_at(lambda s: s.wide.rounds, anew, self.wide.rounds + 1)

    def elsewhere(self, params: Params, theta: Float[Array, " n"]) -> "ResidualSearch":
        """Another search, with all that was evaluated."""
        anew = self.of(theta, self.history)
        anew = dataclasses.replace(anew, pilot=self.pilot, look=self.look)
        return anew.widened(params, theta, jnp.ones_like(theta[0]))

    def widened(
        self, params: Params, theta: Float[Array, " n"], width: Float[Array, ""]
    ) -> "ResidualSearch":
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

    def counted(self, small: Array, teaches: Array, last: Array, count: int) -> "ResidualSearch":
        """Two answers are in doubt until wide rounds have looked around once.

        One is that in a ripple. The other is one where a parameter that mattered changes nothing,
        as a whole number does: several parameters may have to step together.
        """
        after = super().counted(small, teaches, last, count)
        unseen = (self.wide.rounds == 0) & self.is_local()
        ripple = self.trust.of_ripple() & self.much()
        doubt = after.converged() & unseen & (ripple | self.stands_still())
        around = after._to_wide(jnp.ones_like(self.wide.scale))
        around = eqx.tree_at(lambda s: s.small, around, jnp.zeros_like(self.small))
        return where(doubt, around, after)

    def propose(
        self,
        params: Params,
        draw: Callable[[int], Float[Array, "k n"]],
        sizes: Sizes,
        stage: int | None = None,
    ) -> tuple[Float[Array, "K n"], Proposal]:
        """The first points, the end of a step, or the next samples of a round."""
        params = self.scaled(params)
        sigma = params.sigma
        count, n = sizes.step, len(sigma)
        slot = jnp.arange(count, dtype=jnp.int32)
        nothing = self.trust.nothing(count)

        def first() -> tuple[Array, Proposal]:
            low, high = sides_of(params, self.start)
            units = jnp.eye(n, dtype=sigma.dtype)
            if low is not None and high is not None:
                units = jnp.where(((high >= 1) | (high >= -low))[:, None], units, -units)
            units = jnp.where(self.first.turned[:, None], -units, units)
            others = lambda: draw(max(sizes.first - 1, 1))
            return self.start[None] + sigma[None] * self.first.points(units, others, count), nothing

        def local() -> tuple[Array, Proposal]:
            center, row, _ = self.history.best(self.start)
            sides = sides_of(params, center)
            proposal = self.trust.propose(
                self.history, center, row, sigma, sides, count, self.evaluated
            )
            return center[None] + sigma[None] * proposal.points, proposal

        def wide() -> tuple[Array, Proposal]:
            keyed = self.average is not None
            wide, samples = self.wide, draw(sizes.first if keyed else max(sizes.first - 1, 1))
            width = sigma * wide.scale
            share, index = wide.places(sizes, keyed)
            samples = share[:, None] * samples[jnp.clip(index, 0, len(samples) - 1)]
            points = jax.vmap(params.reflected)(wide.center[None] + width[None] * samples)
            step, worth = further(wide.move, width)
            # at the bounds it may be one that is known
            end = params.clip(wide.center + step)
            same = jnp.all(self.history.points == end[None], axis=1) & self.history.valid
            worth &= ~jnp.any(same)
            points = jnp.where(((wide.taken + slot == 1) & worth)[:, None], end[None], points)
            return jnp.where((share == 0)[:, None], wide.center[None], points), nothing

        pilot = lambda: (self.pilot.points(params, self.start, draw, count), nothing)
        branches = [first, local, wide, pilot]
        if (look := self.look) is not None:
            best = self.history.best(self.start)[0]
            branches.append(lambda: (look.points(params, best, draw, count), nothing))
        return by_stage(self.stage, stage, branches)

    def after(
        self,
        params: Params,
        new: History,
        proposal: Proposal,
        sizes: Sizes,
        stage: int | None = None,
    ) -> "ResidualSearch":
        """The search with these residuals at these points."""
        params = self.scaled(params)
        here = self.history.best(self.start)
        # what the radius learns of a step that failed is that it failed
        barred = new.barred(here[1], here[2], jnp.max(proposal.reduction), squares=True)
        with_rows = self.kept(where(self.is_local() & self.at_edge(), barred, new))
        branches = [
            lambda: with_rows._after_first(
                params, jnp.where(new.valid, new.funs, jnp.inf)
            ).piloting(params),
            lambda: with_rows._after_local(here[1], new.rows, new.valid, proposal, sizes),
            lambda: with_rows._after_wide(params, new.rows, new.valid, sizes),
            lambda: with_rows.piloted(params, new),
        ]
        if self.look is not None:
            branches.append(lambda: with_rows.after_look(params, sizes.step))
        return by_stage(self.stage, stage, branches)

    def _to_wide(self, scale: Array) -> "ResidualSearch":
        center, row, _ = self.history.best(self.start)
        wide = Wide.start(center, row, scale)
        # the center is known: the samples begin at once
        wide = eqx.tree_at(
            lambda w: (w.taken, w.rounds), wide, (jnp.ones_like(wide.taken), self.wide.rounds + 1)
        )
        stage, turn = jnp.full_like(self.stage, WIDE), Turn.start(len(center), self._level())
        return eqx.tree_at(lambda s: (s.stage, s.wide, s.turn), self, (stage, wide, turn))

    def _after_first(self, params: Params, funs: Float[Array, " K"]) -> "ResidualSearch":
        sides = [jnp.abs(s) for s in sides_of(params, self.start) if s is not None]
        both = jnp.all(jnp.stack([jnp.full_like(self.start, jnp.inf), *sides]) >= 1, axis=0)
        first = self.first.after(funs, both)
        too_near = self.too_near(params.sigma)
        first = where(first.done() & jnp.any(too_near), first.again(too_near, FARTHER), first)
        stage = jnp.where(first.done(), TRUST, FIRST).astype(self.stage.dtype)
        alone, here = self.history.alone(self.start)
        changed = ~alike(self.history.rows, self.history.rows[here])[:, None]
        new = stage, first, jnp.any(alone & changed, axis=0)
        known = eqx.tree_at(lambda s: (s.stage, s.first, s.matters), self, new)
        _, row, _ = self.history.best(self.start)
        moved = ~alike(self.history.rows, row) & self.history.valid
        few = 2 * (1 + jnp.sum(moved)) <= jnp.sum(self.history.valid)
        return where(first.done() & few, known._to_wide(jnp.ones_like(self.wide.scale)), known)

    def _after_local(
        self, row: Array, rows: Array, good: Array, proposal: Proposal, sizes: Sizes
    ) -> "ResidualSearch":
        trust = self.trust.revise(proposal, row, rows, good, compared=self.average is None)
        changed = trust, self.turn.more(sizes.step)
        local = eqx.tree_at(lambda s: (s.trust, s.turn), self, changed)
        failed = trust.failed()
        after = where(failed, local._to_wide(self.wide.later_scale()), local)
        # where a test was lost, wide rounds go on as they were
        ended = self.turn.test & (local.turn.over() | failed)
        turn, lost = local._next_turn(failed)
        tested = dataclasses.replace(local, turn=turn)
        changed = jnp.full_like(self.stage, WIDE), jnp.zeros_like(self.wide.idle)
        resumed = eqx.tree_at(lambda s: (s.stage, s.wide.idle), tested, changed)
        return where(ended, where(lost, resumed, tested), after)

    def _after_wide(
        self, params: Params, rows: Array, good: Array, sizes: Sizes
    ) -> "ResidualSearch":
        _, lowest, fun = self.history.best(self.start)
        wanted = self.wide.size(sizes, self.average is not None)
        wide = self.wide.sampled(params, self.history, rows, good, lowest, fun)
        average, full = self.average, wide.taken >= wanted
        moved = lambda: wide.stepped(self.history, params, wanted, takes_key=average is not None)
        wide = jax.lax.cond(full, moved, lambda: wide)
        changed = wide, self.turn.more(sizes.step)
        search = eqx.tree_at(lambda s: (s.wide, s.turn), self, changed)
        if average is not None:
            return search.with_mean(where(full, average.after(wide.center), average))
        came_true, n = wide.came_true(), len(self.start)
        # the local model begins anew around what was found, or goes on
        radius = jnp.where(
            came_true,
            2 * jnp.linalg.norm(wide.move / params.sigma),
            _NARROWER * jnp.minimum(jnp.sqrt(jnp.mean(wide.scale**2)), 1),
        )
        radius = jnp.maximum(jnp.asarray(radius), jnp.finfo(fun.dtype).eps)
        anew = TrustRegion.start(jnp.asarray(radius), *self.trust.jacobian.shape)
        trust = where(came_true | wide.found, anew, self.trust.resumed())
        ended = came_true | wide.came_to_nothing()
        # or it shows between rounds how fast it is
        level = self._level()
        lower, _ = search.turn.lowered(level)
        tests = full & search.turn.over() & lower & wide.may_wait()
        turn = where(ended, Turn.start(n, level), search._next_turn(jnp.asarray(False))[0])
        changed = jnp.full_like(self.stage, TRUST), trust, turn
        back = eqx.tree_at(lambda s: (s.stage, s.trust, s.turn), search, changed)
        return where(ended | tests, back, search)

    def _next_turn(self, failed: Bool[Array, ""]) -> tuple[Turn, Bool[Array, ""]]:
        """The turn after this one, and whether the other model has it."""
        no = jnp.asarray(False)
        return self.turn.next(self._level(), len(self.start), (failed, no), no)

    def _level(self) -> Float[Array, ""]:
        """What turns are compared by: a loss falls by shares, and never below zero."""
        fun = self.history.best(self.start)[2]
        return jnp.log(jnp.maximum(fun, jnp.finfo(fun.dtype).tiny))
