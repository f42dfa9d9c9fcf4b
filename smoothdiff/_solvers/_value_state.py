"""Where a search for the minimum of one number stands: how it begins, and how it ends."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from smoothdiff._params import Params
from smoothdiff._solvers._box import has_box
from smoothdiff._solvers._fall import Fall
from smoothdiff._solvers._first_points import FARTHER, NEARER, FirstPoints
from smoothdiff._solvers._history import History
from smoothdiff._solvers._metric import Metric
from smoothdiff._solvers._parameter_scan import Scan
from smoothdiff._solvers._pilot import Pilot
from smoothdiff._solvers._point_search import AbstractPointSearch
from smoothdiff._solvers._quadratic_trust import QuadraticTrust
from smoothdiff._solvers._ratio_test import is_narrow, rounding_alone
from smoothdiff._solvers._regression_step import Center
from smoothdiff._solvers._stages import FIRST, SCAN, WIDE, Sizes
from smoothdiff._solvers._turns import Turn
from smoothdiff._solvers._where import where

# of so many later searches one begins at the start
_PATIENT = 4
# first points on so many sides of each parameter
SIDES = 2
# first points that fail come nearer until they are so near, in sigma
_NEAREST = 1e-5
# a search of a function without noise ends after so many times its patience without progress
_PATIENCES = 2
# a parameter whose start is near its lowest point by chance brings others no nearer than this
_LEAST_NEAR = 0.25
# the widths of later searches, in sigma, as powers of ten at random
_NARROWEST, _WIDEST = -1.5, 0.3


class ValueState(AbstractPointSearch):
    """Where a search stands, with the local model and the center of the wide samples.

    `place` is where the local model was. Searches after the first, which `searches` counts, are the
    wide model's alone, in turns a patient one at the start and some elsewhere. A `scan` of the
    parameters, one by one, if there is one, is tried in a first search that is long, or else before
    the second; what that finds is searched like the first. A patient search never goes back to the
    lowest sample: what is lowest by chance does not lead it away from where the smoothed function
    is low. Nor does any search where the function is `noisy`: where it gave another value for the
    same point, which the first round of samples begins with. Parameters are `unchanging` whose
    first points had the value of the start. First points that are left are `near` times as far as
    sigma says. `much` says when the function last fell by
    much, in steps and rounds of this search.
    """

    scan: Scan | None
    searches: Int[Array, ""]
    noisy: Bool[Array, ""]
    unchanging: Bool[Array, " n"]
    near: Float[Array, ""]
    much: Fall
    trust: QuadraticTrust
    place: Float[Array, " n"]
    center: Center
    taken: Int[Array, ""]
    rounds: Int[Array, ""]
    turn: Turn

    @classmethod
    def of(
        cls,
        params: Params,
        theta: Float[Array, " n"],
        width: Array,
        history: History,
        first: FirstPoints | None = None,
    ) -> "ValueState":
        """Nothing is known but what is in the history; the first samples are so wide.

        Unless other first points are given, they are the start and two for each parameter.
        """
        first = FirstPoints.start(theta, SIDES) if first is None else first
        none, n, sigma = jnp.zeros((), jnp.int32), len(theta), first.reach * params.sigma
        center = Center.start(theta, Metric.of(sigma, True))
        center = eqx.tree_at(lambda c: c.trust.width, center, width)
        never = jnp.zeros_like(width)
        return cls(
            stage=jnp.asarray(FIRST, jnp.int32),
            history=history,
            start=theta,
            evaluated=none,
            small=none,
            fall=Fall.start(never),
            pilot=Pilot.start(theta),
            average=None,
            look=None,
            first=first,
            scan=None,
            searches=none,
            noisy=jnp.asarray(False),
            unchanging=jnp.zeros(n, bool),
            near=jnp.ones_like(never),
            much=Fall.start(never),
            trust=QuadraticTrust.start(sigma, width),
            place=theta,
            center=center,
            taken=none,
            rounds=none,
            turn=Turn.start(n, never),
        )

    def again(
        self,
        params: Params,
        theta: Float[Array, " n"],
        start: Float[Array, " n"],
        lowest: tuple[Float[Array, " n"], Float[Array, ""]],
        key: Array,
    ) -> "ValueState":
        """Another search: in turns a patient one at the start, and some elsewhere of any width.

        It begins with a scan of the parameters, if one is due.
        """
        empty = jax.tree.map(jnp.zeros_like, self.history)
        searches = self.searches + 1
        here = self.patient(searches)
        power = jax.random.uniform(key, (), theta.dtype, _NARROWEST, _WIDEST)
        theta, width = jnp.where(here, start, theta), jnp.where(here, 1, 10**power)
        anew = self.of(params, theta, width, empty)
        stage = jnp.full_like(self.stage, WIDE)
        if self.scan is not None:
            scan, scans = self.scan.next(params, *lowest)
            anew = dataclasses.replace(anew, scan=scan)
            stage = jnp.where(scans, SCAN, stage).astype(stage.dtype)
        # its place is as good as that of a look, of which there is no other
        anew = dataclasses.replace(anew, look=self.look, unchanging=self.unchanging)
        changed = stage, self.rounds + 1, searches, self.noisy
        return eqx.tree_at(lambda s: (s.stage, s.rounds, s.searches, s.noisy), anew, changed)

    def widened(
        self, params: Params, theta: Float[Array, " n"], width: Float[Array, ""]
    ) -> "ValueState":
        """With all first points again."""
        fun = self.history.best(theta)[2]
        return self.anew(params, theta, FirstPoints.start(theta, SIDES).around(fun), width)

    def compared(self) -> "ValueState":
        """With what the first points say of each parameter alone."""
        history = self.history
        alone, here = history.alone(self.start)
        changes = jnp.any(alone & (history.funs != history.funs[here])[:, None], axis=0)
        # on a plateau nothing is known of any
        unchanging = jnp.any(alone, axis=0) & ~changes & jnp.any(changes)
        return eqx.tree_at(lambda s: s.unchanging, self, unchanging)

    def nearer(self) -> Float[Array, " n"]:
        r"""How far each parameter's first points should have been, as a share of how far they are.

        Where both are higher than the start, the parabola through all three is lowest at s, in
        units of how far they are, and four times as far is enough. With one to each side:

        $$ 4 |s|, \quad s = \frac{f_- - f_+}{2 (f_+ + f_- - 2 f_0)} $$
        """
        history = self.history
        alone, here = history.alone(self.start)
        steps = jnp.where(alone, history.points - self.start[None], 0)
        rise = jnp.where(alone, (history.funs - history.funs[here])[:, None], 0)
        higher = (jnp.sum(alone, axis=0) == SIDES) & jnp.all(~alone | (rise > 0), axis=0)
        higher &= history.valid[here] & jnp.all(history.points[here] == self.start)
        # each in units of the largest, as powers might overflow; at a bound both are on one side
        most = lambda a: jnp.maximum(jnp.max(jnp.abs(a), axis=0)[None], jnp.finfo(a.dtype).tiny)
        steps, rise = steps / most(steps), rise / most(rise)
        moment = lambda power, by: jnp.sum(steps**power * by, axis=0)
        slope = moment(1, rise) * moment(4, 1.0) - moment(2, rise) * moment(3, 1.0)
        bend = moment(2, rise) * moment(2, 1.0) - moment(1, rise) * moment(3, 1.0)
        share = 2 * jnp.abs(slope) / jnp.where(bend > 0, bend, 1)
        told = higher & (bend > 0) & jnp.isfinite(share)
        return jnp.where(told, jnp.clip(share, _LEAST_NEAR, 1), 1)

    def narrowed(self, params: Params, over: "ValueState", sizes: Sizes) -> "ValueState":
        """What is `over` if the first points tell of each parameter; else those that do not again.

        Where both of a parameter fail, they come nearer; where they are nothing beside others, and
        change nothing, they go farther.
        """
        history, newest = self.history, self.evaluated + sizes.step
        recent = jnp.arange(len(history.valid), dtype=jnp.int32) >= len(history.valid) - newest
        moved, valid = history.points != self.start[None], history.valid[:, None]
        # where several run at once, others fill the places that are left
        alone = moved & (jnp.sum(moved, axis=1) == 1)[:, None]
        told = jnp.any(alone & valid, axis=0)
        failed = jnp.any(alone & ~valid & recent[:, None], axis=0) & ~told
        failed &= self.first.reach > _NEAREST
        near = self.too_near(self.first.reach * params.sigma) & ~failed
        again = self.first.again(failed | near, jnp.where(near, FARTHER, NEARER))
        # where the start has no value, from a point that has one
        best, _, fun = history.best(self.start)
        known = jnp.any(history.valid & ~jnp.any(moved, axis=1))
        first = where(known, again, again.around(fun))
        # with the radius that a pilot found, as there was no step since
        anew = self.anew(params, jnp.where(known, self.start, best), first, self.trust.radius)
        anew = dataclasses.replace(anew, evaluated=self.evaluated)
        return where(jnp.any(history.valid) & jnp.any(failed | near), anew, over)

    def elsewhere(self, params: Params, theta: Float[Array, " n"]) -> "ValueState":
        """The same search from there."""
        assert self.look is not None
        anew = self.widened(params, theta, self.look.reach(params, theta))
        return dataclasses.replace(anew, rounds=jnp.zeros_like(self.rounds))

    def anew(self, params: Params, theta: Array, first: FirstPoints, width: Array) -> "ValueState":
        """The same search from another point, with all that was evaluated."""
        names = "pilot", "average", "look", "searches", "rounds", "noisy", "scan", "unchanging"
        anew = self.of(params, theta, width, self.history, first)
        return dataclasses.replace(anew, **{name: getattr(self, name) for name in names})

    def may_run_off(self, params: Params) -> Bool[Array, ""]:
        """A search for one number may."""
        if (look := self.look) is None:
            return jnp.asarray(False)
        return self.converged() & look.is_far(params, self.history.best(self.start)[0])

    def look_due(self, params: Params, sizes: Sizes) -> Bool[Array, ""]:
        """Also where the function hardly falls: the way to the end may be long, and gain little.

        And between rounds, once the local model has failed: wide samples alone take long. Not where
        a round has shown noise; before the first one nobody knows.
        """
        between = (self.stage == WIDE) & (self.rounds > 0) & (self.taken == 0)
        hardly = self.much.long_ago(len(self.start), sizes.step)
        # a model that predicts now may be on its way through a long valley
        hardly &= (self.is_local() | between) & ~self.trust.predicts()
        early = hardly | (between & self.trust.failed())
        return super().look_due(params, sizes) | (early & has_box(params) & ~self.noisy)

    def lost(self, sizes: Sizes) -> Bool[Array, ""]:
        """Whether neither model leads anywhere; after one converged the wide one may yet."""
        narrow = is_narrow(self.center.trust.width) & ~self.noisy
        lost = self.center.lost(sizes) | (narrow & (self.fall.since >= sizes.patience))
        lost &= self.trust.failed() | self.later()
        # the smoothed function may fall for long where the function itself does not
        searches = (self.is_local() | (self.stage == WIDE)) & (self.rounds > 0) & ~self.noisy
        lost |= searches & (self.fall.since >= _PATIENCES * sizes.patience)
        return lost if self.scan is None else lost | (self.scan.failed & (self.stage == SCAN))

    def patient(self, searches: Int[Array, ""]) -> Bool[Array, ""]:
        """Whether the search with this number is a patient one."""
        return searches % _PATIENT == (1 if self.scan is None else 2)

    def later(self) -> Bool[Array, ""]:
        """Whether there are wide samples alone."""
        scanned = jnp.asarray(False) if self.scan is None else self.scan.done()
        return ((self.searches if self.average is None else self.rounds) > 0) & ~scanned

    def length(self) -> Float[Array, ""]:
        """The radius, or the width of the samples."""
        return jnp.where(self.stage == WIDE, self.center.trust.width, self.trust.radius)

    def ignored(self) -> Bool[Array, " n"]:
        """By the first points; where the function has noise they may be the same by chance."""
        return self.unchanging & ~self.noisy

    def candidates(
        self, start: Float[Array, " n"], lowest: Float[Array, " n"]
    ) -> list[Float[Array, " n"]]:
        """The lowest point, with parameters that changed nothing back at the start.

        If there are none, the center of the first search: with noise the lowest point owes much to
        luck, it little. Of a function that takes random numbers the mean and where the local model
        ended: in a narrow valley that is bent, the mean is beside it.
        """
        if self.average is not None:
            return [*super().candidates(start, lowest), self.place]
        ignored = self.ignored()
        back = jnp.where(ignored, start, lowest)
        # a later search may have another minimum
        center = jnp.where(self.searches == 0, self.center.theta, lowest)
        return [jnp.where(jnp.any(ignored), back, center)]

    def round(self) -> Int[Array, ""]:
        """So many rounds of samples."""
        return self.rounds

    def smoothing(self) -> Float[Array, ""]:
        """Half the trace of the model's Hessian."""
        return jnp.trace(self.trust.hessian) * self.length() ** 2 / 2

    def checks_noise(self) -> Bool[Array, ""]:
        """Whether a point is evaluated again that was evaluated before."""
        return (self.rounds == 0) & (self.taken == 0)

    def at_bottom(self, sizes: Sizes, width: Float[Array, ""]) -> Bool[Array, ""]:
        """Whether the last evaluations, so far apart, say that nothing lower is near."""
        return rounding_alone(*self.last(sizes), width)

    def last(self, sizes: Sizes) -> tuple[Float[Array, " K"], Bool[Array, " K"]]:
        """The values of the last round of samples, and which of them count."""
        return self.history.funs[-sizes.first :], self.history.valid[-sizes.first :]
