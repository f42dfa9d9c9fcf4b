r"""Gauss-Newton within a trust region, one evaluation a step: while a local model predicts.

Around the best point the residuals are modelled as $r + J u$. J is that of `nearest_fit`, which
changes the last one least, so n + 1 evaluations are enough to begin with.

Source: own; the first points and the ratio test are those of DFO-LS (Cartis, Fiala, Marteau and
Roberts, 2019).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from smoothdiff._products import dot
from smoothdiff._solvers._at_once import beside, least_length, radii
from smoothdiff._solvers._bounded_step import bounded_step
from smoothdiff._solvers._history import History
from smoothdiff._solvers._nearest_fit import nearest_fit
from smoothdiff._solvers._ratio_test import (
    INSIDE,
    LEAST,
    is_narrow,
    lost_in_rounding,
    ratio_test,
    settled,
    taken_by_rounding,
)
from smoothdiff._solvers._residual_check import check_step, checked, newer

# a step is foreseen if the change of the residuals was predicted with an error below this share
_PREDICTED = 0.5
# a model that holds no further than so many sigmas may be that of a ripple
_RIPPLE = 0.01
# the radius after a failure, in lengths of the step
_SMALLEST, _LARGEST = 0.1, 0.5
# so many steps in a row that fail, or fail and are rough, are too many; of the latter one, where no
# step worked yet
_FAILS, _ROUGH = 8, 2
# ... and so many evaluations for each parameter that lower the loss by less than this share
_SLOW, _LITTLE = 3, 0.01
# a reduction is nothing below so many roundings, squared, of the largest loss
_FLOOR = 100
# what promises no more than so many roundings of the loss, and comes to that, is neither a failure
# nor a success
_ROUNDINGS = 64
# a step shorter by the first factor should lower the error of the prediction below the second one,
# or the function is rough
_SHORTER, _SMOOTH = 0.6, 0.8


class Proposal(NamedTuple):
    """Points to evaluate, in units of sigma, and what the model says of them.

    The `others` are no steps, see `beside`. The first is a `check` where the model asks for
    nothing. A step may be `lost` in the rounding of the parameters. One of a sigma, or as long as
    the radius if that is more, would reduce the loss by what is `ahead`.
    """

    points: Float[Array, "K n"]
    others: Bool[Array, " K"]
    predicted: Float[Array, "M P"]
    reduction: Float[Array, " M"]
    slope: Float[Array, " M"]
    ahead: Float[Array, ""]
    jacobian: Float[Array, "n P"]
    poor: Bool[Array, ""]
    check: Bool[Array, ""]
    lost: Bool[Array, " M"]


class TrustRegion(eqx.Module):
    """How far the model is trusted, in units of sigma, and the last model.

    `improve` says that the next evaluation is for the geometry of the points, not for a step.
    `fails` counts the steps in a row that failed, `rough` those of them that were shorter than the
    one before and predicted no better, as happens where a function jumps, or changed nothing at
    all; `error` and `length` are those of the last one. `worked` says that some step did not fail,
    and `slow` counts the evaluations in a row that lowered the loss by little or nothing, while the
    radius did not grow. The next point may be a `check`. The last step may be `settled`, see there,
    or `level`: it promised no more than rounding, and came to that; and the model may be `right`
    about a check. `foreseen` is the length of the longest very successful step that was foreseen.
    """

    radius: Float[Array, ""]
    jacobian: Float[Array, "n P"]
    improve: Bool[Array, ""]
    fails: Int[Array, ""]
    rough: Int[Array, ""]
    error: Float[Array, ""]
    length: Float[Array, ""]
    worked: Bool[Array, ""]
    slow: Int[Array, ""]
    check: Bool[Array, ""]
    settled: Bool[Array, ""]
    level: Bool[Array, ""]
    right: Bool[Array, ""]
    foreseen: Float[Array, ""]

    @staticmethod
    def start(radius: Float[Array, ""], n: int, size: int) -> "TrustRegion":
        """Nothing is known of the function."""
        none, zero, no = jnp.zeros((), jnp.int32), jnp.zeros_like(radius), jnp.asarray(False)
        return TrustRegion(
            radius=radius,
            jacobian=jnp.zeros((n, size), radius.dtype),
            improve=no,
            fails=none,
            rough=none,
            error=zero,
            length=zero,
            worked=no,
            slow=none,
            check=no,
            settled=no,
            level=no,
            right=no,
            foreseen=zero,
        )

    def nothing(self, count: int) -> Proposal:
        """No steps, where so many other points are evaluated."""
        n, size = self.jacobian.shape
        tried = len(radii(self.radius, count))
        zeros = lambda *shape: jnp.zeros(shape, self.radius.dtype)
        return Proposal(
            points=zeros(count, n),
            others=jnp.zeros(count, bool),
            predicted=zeros(tried, size),
            reduction=zeros(tried),
            slope=zeros(tried),
            ahead=zeros(),
            jacobian=self.jacobian,
            poor=jnp.asarray(False),
            check=jnp.asarray(False),
            lost=jnp.zeros(tried, bool),
        )

    def failed(self) -> Bool[Array, ""]:
        """Whether a local model is of no use."""
        return (
            (self.fails >= _FAILS)
            | (self.slow >= _SLOW * (len(self.jacobian) + 1))
            | (self.rough >= jnp.where(self.worked, _ROUGH, 1))
        )

    def of_ripple(self) -> Bool[Array, ""]:
        """Whether only ripples far shorter than sigma were predicted, and failures led there."""
        return (self.foreseen < _RIPPLE) & (self.radius < _RIPPLE)

    def resumed(self) -> "TrustRegion":
        """After a turn of the other model: what failed before no longer counts."""
        none = jnp.zeros_like(self.fails)
        no, yes = jnp.zeros_like(self.improve), jnp.ones_like(self.worked)
        return eqx.tree_at(
            lambda t: (t.fails, t.rough, t.slow, t.improve, t.level, t.right, t.worked),
            self,
            (none, none, none, no, no, no, yes),
        )

    def propose(
        self,
        history: History,
        center: Float[Array, " n"],
        row: Float[Array, " P"],
        sigma: Float[Array, " n"],
        sides: tuple[Array | None, Array | None],
        count: int,
        turn: Int[Array, ""],
    ) -> Proposal:
        """Minimisers of the model within this radius and others, and points for the geometry.

        So many points, after as many evaluations as `turn` says.
        """
        fit = nearest_fit(history, center, row, sigma, self.radius, self.jacobian)
        jacobian = fit.jacobian
        hessian, grad = dot(jacobian, jacobian.T), dot(jacobian, row)
        tried = jnp.append(radii(self.radius, count), jnp.maximum(self.radius, 1))
        steps = jax.vmap(lambda radius: bounded_step(hessian, grad, radius, *sides))(tried)
        change, slope = dot(steps, jacobian), -dot(steps, grad)
        reduction = slope - jnp.sum(change**2, axis=1) / 2
        # squares of residuals that were once larger are not known any better than that
        largest = jnp.max(jnp.where(history.valid, history.funs, 0))
        ahead = reduction[-1] - _FLOOR * jnp.finfo(row.dtype).eps ** 2 * largest
        steps, change, slope, reduction = (a[:-1] for a in (steps, change, slope, reduction))
        # where the model asks for nothing, a point that teaches it something
        eps = jnp.finfo(row.dtype).eps
        check = self.check | ~(reduction[0] > eps * jnp.sum(row**2))
        improve = self.improve | check
        farthest = jnp.where(self.check, jnp.maximum(self.radius, 1), self.radius)
        away = jnp.where(history.valid[:, None], (history.points - center[None]) / sigma[None], 0)
        # to both sides in turns
        lacking = self.radius * jnp.where(turn // count % 2 == 0, fit.lacking, -fit.lacking)
        telling = lambda: newer(check_step(fit, row, center / sigma, farthest), away)
        # a check is rare, and takes two decompositions
        other = _roomy(jax.lax.cond(check, telling, lambda: lacking), *sides)
        first = steps.at[0].set(jnp.where(improve, other, steps[0]))
        change = change.at[0].set(dot(first[0], jacobian))
        low, high = (None if side is None else side[None] for side in sides)
        inside = lambda ends: jnp.clip(ends, low, high)
        least = least_length(center / sigma)
        points, others = beside(first, steps[0], self.radius, least, inside, count, turn)
        reduction = reduction.at[0].set(jnp.where(improve, 0, reduction[0]))
        predicted = row[None] + change
        lost = jax.vmap(lambda step: _is_lost(step, center, sigma))(steps)
        # a step that the radius made short may be a first one
        lost &= (jnp.linalg.norm(steps, axis=1) < INSIDE * tried[:-1]) & ~improve
        said = ahead, jacobian, fit.poor, check, lost
        return Proposal(points, others, predicted, reduction, slope, *said)

    def revise(
        self,
        proposal: Proposal,
        row: Float[Array, " P"],
        rows: Float[Array, "K P"],
        good: Array,
        compared: bool = True,
    ) -> "TrustRegion":
        """The region after the residuals `rows` came.

        They are `compared` with the model, for a check, unless others were drawn with another key.
        """
        before = jnp.sum(row**2) / 2
        funs = jnp.where(good, jnp.sum(rows**2, axis=1) / 2, jnp.inf)
        lowest, funs = jnp.min(funs), jnp.where(proposal.others, jnp.inf, funs)
        best = jnp.argmin(funs)
        # what rounding may do says nothing against a model whose last steps came true
        fun, promise = funs[best], proposal.reduction[best]
        reached = before - fun > LEAST * promise
        lost = proposal.lost[best] & self.settled & jnp.isfinite(fun) & ~reached
        length: Array = jnp.linalg.norm(proposal.points[best])
        tested = radii(self.radius, len(funs))
        rounding = _ROUNDINGS * jnp.finfo(row.dtype).eps * before
        level = (promise <= rounding) & (jnp.abs(before - fun) <= rounding)
        level &= ~self.improve & ~proposal.check & (proposal.ahead <= rounding)
        # a radius below a sigma may be what made the promise small
        level &= (length < INSIDE * tested[best]) | (self.radius >= 1)
        little = lost | level | ~(promise > 2 * jnp.finfo(row.dtype).eps * before)
        reduction = jnp.where(little, 0, promise)
        tiny = jnp.finfo(row.dtype).tiny
        off = jnp.linalg.norm(rows[best] - proposal.predicted[best])
        expected = jnp.linalg.norm(proposal.predicted[best] - row)
        error = off / jnp.maximum(expected, tiny)
        error = jnp.asarray(jnp.where(jnp.isfinite(fun), error, jnp.inf))
        outcome = ratio_test(before, fun, reduction, self.fails)
        # what is far ahead of a radius that failures made small has not converged
        promised = outcome.more | (proposal.ahead > taken_by_rounding(before))
        outcome = outcome._replace(more=promised)
        tried, failed, very_successful, long, fails, _ = outcome
        shorter = (self.fails > 0) & (length < _SHORTER * self.length)
        more = jnp.all(rows[best] == row) | (shorter & (error >= _SMOOTH * self.error))
        rough = jnp.where(more, self.rough + 1, self.rough)
        rough = jnp.where(tried & ~failed, 0, jnp.where(failed & ~long, rough, self.rough))
        # the lowest point of the parabola through both values and the slope
        slope = proposal.slope[best]
        share = slope / jnp.maximum(2 * (fun - before + slope), tiny)
        share = jnp.clip(jnp.where(jnp.isfinite(fun), share, 0), _SMALLEST, _LARGEST)
        wait = proposal.poor & (fails < 2) & ~self.improve & ~long
        radius = jnp.where(failed & ~wait, jnp.minimum(self.radius, length) * share, self.radius)
        # single residuals may jump while the loss comes down as predicted
        radius = jnp.where(very_successful, jnp.maximum(radius, 2 * length), radius)
        asked = proposal.check & good[0] & compared
        check = checked(row, rows[0], proposal.predicted[0], proposal.ahead, asked)
        after = jnp.minimum(check.factor * radius, jnp.maximum(radius, 1))
        radius = jnp.where(tried | self.improve | lost | level | self.check, radius, after)
        improve = (failed | level) & proposal.poor & ~self.improve & ~self.check
        faster = (lowest < (1 - _LITTLE) * before) | very_successful | check.right
        came = self.settled | (level & (fun <= before))
        known = very_successful & (error < _PREDICTED)
        return TrustRegion(
            radius=radius,
            jacobian=proposal.jacobian,
            improve=improve,
            fails=fails,
            rough=rough.astype(fails.dtype),
            error=jnp.where(failed, error, self.error),
            length=jnp.where(failed, length, self.length),
            slow=jnp.where(faster, 0, jnp.where(level, self.slow, self.slow + len(rows))),
            worked=self.worked | (tried & ~failed),
            check=jnp.zeros_like(level),
            settled=check.right | settled(came, outcome, length, tested[best]),
            level=level,
            right=check.right,
            foreseen=jnp.where(known, jnp.maximum(self.foreseen, length), self.foreseen),
        )


def _is_lost(step: Array, center: Array, sigma: Array) -> Array:
    """Whether it is short beside sigma, and of so few roundings that it may come to nothing."""
    return is_narrow(jnp.linalg.norm(step)) & lost_in_rounding(sigma * step, center, sigma)


def _roomy(step: Array, low: Array | None, high: Array | None) -> Array:
    """The step or its opposite, whichever the bounds leave longer."""
    if low is None or high is None:
        return step
    forth, back = jnp.clip(step, low, high), jnp.clip(-step, low, high)
    return jnp.where(jnp.linalg.norm(forth) >= jnp.linalg.norm(back), forth, back)
