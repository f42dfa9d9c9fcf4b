r"""Newton steps within a trust region, one evaluation a step: while a quadratic model predicts.

Around the best point the function is modelled as $f + g \cdot u + \tfrac12 u \cdot H u$, in the
coordinates u in which the Hessian is round, as far as it is known: a narrow valley is as easy as a
bowl. They follow the Hessian of a model whose points determine it, that was right where it was
checked, or that promises nothing within the radius, so that flat directions widen. Of fewer points
a Hessian is a guess, and widths that follow a guess make the next one worse. After a short step
comes a point that checks the model, see there.

Source: the metric is our own.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from smoothdiff._params import Params
from smoothdiff._products import dot
from smoothdiff._solvers._at_once import beside, least_length, radii
from smoothdiff._solvers._base import all_finite
from smoothdiff._solvers._bounded_step import bounded_step
from smoothdiff._solvers._history import History
from smoothdiff._solvers._least_change import least_change
from smoothdiff._solvers._metric import Metric
from smoothdiff._solvers._model_check import check_step, is_right, least_rise, to_new_place
from smoothdiff._solvers._ratio_test import (
    FEW,
    INSIDE,
    TELLING,
    asks_nothing,
    lost_in_rounding,
    nothing,
    ratio_test,
    settled,
)
from smoothdiff._solvers._where import where

# an evaluation so many radii away should make way for a nearer one
_FAR = 2.0
# so many steps that fail in a row are too many for now, and so many evaluations for each parameter,
# and one, without a lower point for good
_FAILS, _SLOW = 5, 10
# a model of which so many more steps of late came true than not predicts
_HITS = 2
# while far points make way for nearer ones, so many failures shrink the radius; none where it is
# no more than that: there the points, and not the radius, are to blame, unless the value is the
# same, as on stairs
_PATIENCE, _NEAR = 2, 0.5


class Proposal(NamedTuple):
    """Points to evaluate, in units of the metric, and what the model says of them.

    The `others` are no steps, see `beside`. The first may be a `check` that the function rises
    there as predicted. The radius is `tight` where the model promises no more within it than
    rounding may take, but may beyond. The Hessian is `determined` by as many points as it takes. A
    step may be `lost` in the parameters' rounding.
    """

    points: Float[Array, "K n"]
    others: Bool[Array, " K"]
    reduction: Float[Array, " M"]
    hessian: Float[Array, "n n"]
    poor: Bool[Array, ""]
    check: Bool[Array, ""]
    rise: Float[Array, ""]
    tight: Bool[Array, ""]
    determined: Bool[Array, ""]
    lost: Bool[Array, " M"]


class QuadraticTrust(eqx.Module):
    """How far the model is trusted, in units of the metric, and the Hessian of the last model.

    The next evaluation is no step where it is to `improve` the geometry of the points, or to
    `check` the model. `fails` counts the steps in a row that failed, `slow` the evaluations without
    a lower point, `hits` the steps of late that did not fail, less those that did. The last step
    may be `settled`, see there, and the model `right` about a check.
    """

    metric: Metric
    radius: Float[Array, ""]
    hessian: Float[Array, "n n"]
    improve: Bool[Array, ""]
    check: Bool[Array, ""]
    fails: Int[Array, ""]
    slow: Int[Array, ""]
    hits: Int[Array, ""]
    settled: Bool[Array, ""]
    right: Bool[Array, ""]

    @staticmethod
    def start(sigma: Float[Array, " n"], radius: Float[Array, ""]) -> "QuadraticTrust":
        """Nothing is known of the function; the metric has sigma as its unit."""
        n, none = len(sigma), jnp.zeros((), jnp.int32)
        hessian = jnp.zeros((n, n), sigma.dtype)
        no = jnp.asarray(False)
        counts = none, none, none
        return QuadraticTrust(Metric.of(sigma, True), radius, hessian, no, no, *counts, no, no)

    def nothing(self, count: int) -> Proposal:
        """No steps, where so many other points are evaluated."""
        zeros, no = lambda *shape: jnp.zeros(shape, self.radius.dtype), jnp.asarray(False)
        return Proposal(
            points=zeros(count, len(self.hessian)),
            others=jnp.zeros(count, bool),
            reduction=jnp.zeros_like(radii(self.radius, count)),
            hessian=self.hessian,
            poor=no,
            check=no,
            rise=zeros(),
            tight=no,
            determined=no,
            lost=jnp.zeros(len(radii(self.radius, count)), bool),
        )

    def failed(self) -> Bool[Array, ""]:
        """Whether the model is of no use here, or nothing is left to do for it."""
        slow = self.slow >= _SLOW * (len(self.hessian) + 1)
        return slow | nothing(self.radius)

    def stuck(self) -> Bool[Array, ""]:
        """Whether the model has not predicted for a while; a smaller radius may yet help."""
        return (self.fails >= _FAILS) | self.failed()

    def predicts(self) -> Bool[Array, ""]:
        """Whether at least half of the steps of late lowered the function."""
        return self.hits >= _HITS

    def teaches(self) -> Bool[Array, ""]:
        """Whether the next evaluation is no step, but to make the model better."""
        return self.improve | self.check

    def retried(self) -> "QuadraticTrust":
        """With the radius as it is, and what came of steps forgotten."""
        none = jnp.zeros_like(self.fails)
        return eqx.tree_at(lambda t: (t.fails, t.hits), self, (none, none))

    def revived(self, radius: Float[Array, ""]) -> "QuadraticTrust":
        """Trusted again, at least as far as this, around another point."""
        none = jnp.zeros_like(self.fails)
        radius, no = jnp.maximum(self.radius, radius), jnp.zeros_like(self.improve)
        counts = none, none, none
        return QuadraticTrust(self.metric, radius, self.hessian, no, no, *counts, no, no)

    def propose(
        self,
        history: History,
        center: Float[Array, " n"],
        fun: Float[Array, ""],
        params: Params,
        count: int,
        turn: Int[Array, ""],
    ) -> Proposal:
        """Minimisers of the model within this radius and others, and points that teach it.

        So many points, after as many evaluations as `turn` says.
        """
        model = least_change(history, center, fun, self.metric, self.radius, self.hessian)
        grad, hessian, (constant, slope, bend) = model.grad, model.hessian, model.polynomial

        tried = radii(self.radius, count)
        # one piece of code solves all, as compiling it takes longer than running it: the steps, and
        # the two ends of what the farthest evaluation determines alone, where one is wanted
        each = (len(tried), *hessian.shape)
        problems = (
            jnp.append(jnp.ones(len(tried), bool), jnp.full(2, self.improve)),
            jnp.concatenate([jnp.broadcast_to(hessian, each), jnp.stack([bend, -bend])]),
            jnp.concatenate([jnp.broadcast_to(grad, each[:2]), jnp.stack([slope, -slope])]),
            jnp.append(tried, jnp.full(2, self.radius)),
        )
        steps = jax.lax.map(lambda problem: self._solution(problem, center, params), problems)
        steps, ends = steps[:-2], steps[-2:]
        change = lambda steps, slope, bend: (
            dot(steps, slope) + jnp.sum(dot(steps, bend) * steps, axis=1) / 2
        )
        reduction = -change(steps, grad, hessian)
        asked = asks_nothing(reduction[0], fun, model.highest, steps[0], self.radius)
        # where the model asks for nothing, a point that teaches it something
        check = self.check | (asked.nothing & ~self.improve)

        inside = lambda ends: self.metric.into(
            jax.vmap(params.clip)(center[None] + self.metric.out(ends)) - center[None]
        )

        def other() -> Array:
            """The end where the polynomial of the farthest evaluation is larger in size."""
            return ends[jnp.argmax(jnp.abs(constant + change(ends, slope, bend)))]

        def checked() -> Array:
            """One of the two ends of a check, within the bounds: the lower one, if it is new."""
            check = check_step(model, self.metric, center, fun, steps[0], self.radius)
            ends = inside(jnp.stack([check, -check]))
            length = jnp.linalg.norm(ends, axis=1)
            short = length < jnp.max(length) / 2
            ends = jnp.where(short[:, None], ends[::-1], ends)
            rise = lambda steps: change(steps, grad, hessian)
            ends = ends[jnp.argsort(rise(ends))]
            return to_new_place(ends, model.away, rise, least_rise(fun))

        which = jnp.where(check, 2, self.improve.astype(jnp.int32))
        first = jax.lax.switch(which, [lambda: steps[0], other, checked])
        rise = change(first[None], grad, hessian)[0]
        steps, step = steps.at[0].set(first), steps[0]
        least = least_length(center / self.metric.widest())
        points, others = beside(steps, step, self.radius, least, inside, count, turn)
        reduction = reduction.at[0].set(jnp.where(which > 0, 0, reduction[0]))
        poor = (model.farthest > _FAR * self.radius) & (model.used > len(center) + 1)
        # a step that the radius made short may be a first one
        lost = jax.vmap(lambda s: lost_in_rounding(s, center, params.sigma))(self.metric.out(steps))
        lost &= jnp.linalg.norm(steps, axis=1) < INSIDE * tried
        said = asked.tight, model.determined, lost
        return Proposal(points, others, reduction, hessian, poor, check, rise, *said)

    def _solution(self, problem: tuple[Array, ...], center: Array, params: Params) -> Array:
        """The minimiser within radius and bounds, or zero where it is not wanted."""
        wanted, hessian, grad, radius = problem
        solve = lambda: self._within_bounds(hessian, grad, radius, center, params)
        return jax.lax.cond(wanted, solve, lambda: jnp.zeros_like(grad))

    def _within_bounds(
        self, hessian: Array, grad: Array, radius: Array, center: Array, params: Params
    ) -> Array:
        """The minimiser within the radius that leaves no bound."""
        if params.bounds is None:
            return bounded_step(hessian, grad, radius, None, None)
        # the bounds are those of the parameters, in units of sigma
        sigma = params.sigma
        units = self.metric.into(jnp.diag(sigma))
        bend, slope = dot(dot(units, hessian), units.T), dot(units, grad)
        low, high = ((side - center) / sigma for side in params.bounds)
        step = bounded_step(bend, slope, radius, low, high, dot(units, units.T))
        return self.metric.into(params.clip(center + sigma * step) - center)

    def revise(
        self,
        proposal: Proposal,
        before: Float[Array, ""],
        funs: Float[Array, " K"],
        good: Bool[Array, " K"],
    ) -> "QuadraticTrust":
        """The region after these values came; its metric follows a Hessian that can be trusted."""
        lowest = jnp.min(jnp.where(good, funs, jnp.inf))
        funs = jnp.where(good & ~proposal.others, funs, jnp.inf)
        best = jnp.argmin(funs)
        # what rounding may do says nothing against the model
        fun, promise = funs[best], proposal.reduction[best]
        unit = jnp.finfo(fun.dtype).eps * jnp.abs(before)
        lost = proposal.lost[best]
        little = lost | ~(promise > unit)
        reduction = jnp.where(little, 0, promise)
        hessian = proposal.hessian
        metric, turn = self.metric.adapted(
            lambda v: dot(hessian, v), jnp.diagonal(hessian), jnp.zeros_like(fun)
        )
        outcome = ratio_test(before, fun, reduction, self.fails)
        _, failed, very_successful, long, fails, _ = outcome
        hit = jnp.where(failed, -1, outcome.tried.astype(fails.dtype))
        # a check is no step, but a model that is right about it may have converged
        right = proposal.check & is_right(before, funs[0], proposal.rise)
        usable = all_finite((metric, turn)) & (right | proposal.tight | proposal.determined)
        still = Metric.of(jnp.ones_like(proposal.points[0]), True)
        metric, turn = where(usable, (metric, turn), (self.metric, still))
        length = jnp.linalg.norm(turn.into(proposal.points[best]))
        tried = radii(self.radius, len(funs))
        # in the units that the step was made in
        moved = jnp.linalg.norm(proposal.points[best])
        # a model of far points is made better before it is trusted less
        patient = (fails < _PATIENCE) | ((self.radius <= _NEAR) & (fun != before))
        wait = proposal.poor & patient & ~long
        fails = jnp.where(wait, jnp.minimum(fails, _PATIENCE), fails)
        lower = jnp.minimum(self.radius, length) * jnp.where(long, 0.1, 0.5)
        # near a minimum rounding may explain a failure, and a check needs the radius to tell
        explained = self.settled & ~(promise > FEW[fun.dtype.name] * unit)
        radius = jnp.where(failed & ~wait & ~explained, lower, self.radius)
        radius = jnp.where(very_successful, jnp.maximum(radius, 2 * length), radius)
        # where a check rose by more than rounding, the radius is not too small to tell
        tells = funs[0] - before > TELLING * unit
        tight = proposal.tight & ~self.teaches() & ~(proposal.check & tells)
        radius = jnp.where(tight, 2 * self.radius, radius)
        ends = settled(self.settled | lost, outcome, moved, tried[best])
        return QuadraticTrust(
            metric=metric,
            radius=radius,
            hessian=turn.out(turn.out(hessian).T),
            improve=failed & proposal.poor,
            check=jnp.zeros_like(self.check),
            fails=fails,
            slow=jnp.where(lowest < before, 0, self.slow + len(funs)).astype(fails.dtype),
            hits=jnp.clip(self.hits + hit, 0, 2 * _HITS),
            settled=jnp.where(proposal.check, right, ends),
            right=right,
        )
