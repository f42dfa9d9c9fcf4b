r"""Newton steps within a trust region, one evaluation a step: while a quadratic model predicts.

Around the best point the function is modelled as $f + g \cdot u + \tfrac12 u \cdot H u$. The model
interpolates the nearest evaluations, and its Hessian differs least, in Frobenius norm, from the
last one. So 2 n + 1 evaluations are enough to begin with. The coordinates u are those in which the
Hessian is round, as far as it is known: a narrow valley is as easy as a bowl.

Source: the least change is Powell's (2004; NEWUOA, BOBYQA); the metric and the weights are our own.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from smoothdiff._params import Params
from smoothdiff._solvers._base import all_finite, dot
from smoothdiff._solvers._bounded_step import bounded_step
from smoothdiff._solvers._history import History
from smoothdiff._solvers._metric import Metric
from smoothdiff._solvers._point_search import nothing, powers_of_two
from smoothdiff._solvers._ratio_test import asks_nothing, ratio_test, settled

# the most evaluations that a model interpolates, if n parameters do not need more
_MOST = 256
# how far they may be, in radii of the region or of the nearest 2 n + 1 of them
_FARTHEST = 3.0
# evaluations higher than so many times the median are interpolated less and less exactly
_HIGH, _HIGHEST = 3.0, 1e6
# the errors of the others, against the squared distances
_RIDGE = {"float32": 1e-7, "float64": 1e-12}
# an evaluation so many radii away should make way for a nearer one
_FAR = 2.0
# so many steps that fail in a row are too many for now, and so many evaluations for each parameter,
# and one, without a lower point for good
_FAILS, _SLOW = 5, 10


class Proposal(NamedTuple):
    """Steps to evaluate, in units of the metric, and what the model says of them.

    It is `done` where it promises no more than rounding may take, whatever the radius.
    """

    steps: Float[Array, "K n"]
    reduction: Float[Array, " K"]
    hessian: Float[Array, "n n"]
    poor: Bool[Array, ""]
    done: Bool[Array, ""]


class QuadraticTrust(eqx.Module):
    """How far the model is trusted, in units of the metric, and the Hessian of the last model.

    `improve` says that the next evaluation is for the geometry of the points, not for a step;
    `fails` counts the steps in a row that failed, `slow` the evaluations without a lower point.
    The last step may be `settled`, see there, and the model `done`.
    """

    metric: Metric
    radius: Float[Array, ""]
    hessian: Float[Array, "n n"]
    improve: Bool[Array, ""]
    fails: Int[Array, ""]
    slow: Int[Array, ""]
    settled: Bool[Array, ""]
    done: Bool[Array, ""]

    @staticmethod
    def start(sigma: Float[Array, " n"], radius: Float[Array, ""]) -> "QuadraticTrust":
        """Nothing is known of the function; the metric has sigma as its unit."""
        n, none = len(sigma), jnp.zeros((), jnp.int32)
        hessian = jnp.zeros((n, n), sigma.dtype)
        no = jnp.asarray(False)
        return QuadraticTrust(Metric.of(sigma, True), radius, hessian, no, none, none, no, no)

    def failed(self) -> Bool[Array, ""]:
        """Whether the model is of no use here, or nothing is left to do for it."""
        slow = self.slow >= _SLOW * (len(self.hessian) + 1)
        return slow | nothing(self.radius)

    def stuck(self) -> Bool[Array, ""]:
        """Whether the model has not predicted for a while; a smaller radius may yet help."""
        return (self.fails >= _FAILS) | self.failed()

    def retried(self) -> "QuadraticTrust":
        """With the radius as it is, and the failed steps forgotten."""
        return eqx.tree_at(lambda t: t.fails, self, jnp.zeros_like(self.fails))

    def revived(self, radius: Float[Array, ""]) -> "QuadraticTrust":
        """Trusted again, at least as far as this, around another point."""
        none = jnp.zeros_like(self.fails)
        radius, no = jnp.maximum(self.radius, radius), jnp.zeros_like(self.improve)
        return QuadraticTrust(self.metric, radius, self.hessian, no, none, none, no, no)

    def propose(
        self,
        history: History,
        center: Float[Array, " n"],
        fun: Float[Array, ""],
        params: Params,
        count: int,
    ) -> Proposal:
        """Minimisers of the model within this radius and others, or a point for the geometry."""
        grad, hessian, (constant, slope, bend), poor, rise = self._fit(history, center, fun)

        def minimiser(hessian: Array, grad: Array, radius: Array) -> Array:
            return self._within_bounds(hessian, grad, radius, center, params)

        radii = self.radius * powers_of_two(count, fun.dtype)
        steps = jax.vmap(lambda radius: minimiser(hessian, grad, radius))(radii)
        reduction = -(dot(steps, grad) + jnp.sum(dot(steps, hessian) * steps, axis=1) / 2)
        # where the model asks for nothing, a point that teaches it something: one of the two ends
        # of what the farthest evaluation determines alone
        done, nothing = asks_nothing(reduction[0], fun, rise, steps[0], self.radius)
        improve = self.improve | nothing

        def other() -> Array:
            ends = jnp.stack([minimiser(s * bend, s * slope, self.radius) for s in (1, -1)])
            moved = dot(ends, slope) + jnp.sum(dot(ends, bend) * ends, axis=1) / 2
            return ends[jnp.argmax(jnp.abs(constant + moved))]

        first = jax.lax.cond(improve, other, lambda: steps[0])
        steps = steps.at[0].set(first)
        reduction = reduction.at[0].set(jnp.where(improve, 0, reduction[0]))
        return Proposal(steps, reduction, hessian, poor, done)

    def _fit(
        self, history: History, center: Array, fun: Array
    ) -> tuple[Array, Array, tuple[Array, Array, Array], Array, Array]:
        """Gradient and Hessian; the polynomial of the farthest point, and whether that is too far.

        The polynomial is 1 there and 0 at the other points, as far as they are interpolated. Last
        comes by how much the highest of them is above the center.
        """
        n, dtype = len(center), fun.dtype
        tiny = jnp.finfo(dtype).tiny
        away = self.metric.into(history.points - center[None])
        length = jnp.linalg.norm(away, axis=1)
        # steps below rounding come back to the center, which once is enough of
        again = history.valid & (length == 0) & (history.funs == fun)
        again &= jnp.arange(len(away)) != jnp.argmax(again)
        everywhere = jnp.where(history.valid & ~again, length, jnp.inf)
        count = max(min((n + 1) * (n + 2) // 2, _MOST), 2 * n + 1)
        nearest, near = jax.lax.top_k(-jnp.asarray(everywhere), min(count, len(away)))
        distance = -jnp.asarray(nearest)
        close = distance[: 2 * n + 1]
        spread = jnp.max(jnp.where(jnp.isfinite(close), close, 0))
        reach = jnp.maximum(self.radius, spread)
        used = distance <= _FARTHEST * reach
        # so that the kernel is about 1, beside which the errors are small
        width = jnp.minimum(reach, jnp.max(jnp.where(used, distance, 0))) + tiny
        a = jnp.where(used[:, None], away[near], 0) / width
        rise = jnp.where(used, history.funs[near] - fun, 0)
        typical = jnp.nanmedian(jnp.where(used, jnp.abs(rise), jnp.nan))
        high, highest = _HIGH * typical + tiny, jnp.max(rise)
        above = jnp.clip(rise / high, 1, _HIGHEST)
        rise = jnp.minimum(rise, _HIGHEST * high)

        old = self.hessian * width**2
        error = jnp.where(used, _RIDGE[dtype.name] * above**2, 1)
        borders = jnp.concatenate([used[:, None].astype(dtype), a], axis=1)
        corner = -jnp.finfo(dtype).eps * jnp.eye(n + 1, dtype=dtype)
        kernel = dot(a, a.T) ** 2 / 2 + jnp.diag(error)
        system = jnp.block([[kernel, borders], [borders.T, corner]])
        farthest = jnp.argmax(jnp.where(used, distance, -1))
        left = rise - jnp.sum(dot(a, old) * a, axis=1) / 2
        sides = jnp.stack([jnp.where(used, left, 0), jnp.eye(len(a), dtype=dtype)[farthest]])
        sides = jnp.pad(sides, ((0, 0), (0, n + 1)))
        factor = jax.scipy.linalg.lu_factor(system)
        solved = jax.scipy.linalg.lu_solve(factor, sides.T)
        # once more for what rounding left, which is much in float32
        solved += jax.scipy.linalg.lu_solve(factor, sides.T - dot(system, solved))
        solved = solved.T
        solved = jnp.asarray(jnp.where(jnp.all(jnp.isfinite(solved)), solved, 0))
        bends = [dot(a.T * weights[None], a) for weights in solved[:, : len(a)]]
        constants, slopes = solved[:, len(a)], solved[:, len(a) + 1 :] / width
        polynomial = constants[1], slopes[1], bends[1] / width**2
        poor = (distance[farthest] > _FAR * self.radius) & (jnp.sum(used) > n + 1)
        return slopes[0], (old + bends[0]) / width**2, polynomial, poor, highest

    def _within_bounds(
        self, hessian: Array, grad: Array, radius: Array, center: Array, params: Params
    ) -> Array:
        """The minimiser within the radius that leaves no bound."""
        if params.low is None or params.high is None:
            return bounded_step(hessian, grad, radius, None, None)
        # the bounds are those of the parameters, in units of sigma
        sigma = params.sigma
        units = self.metric.into(jnp.diag(sigma))
        bend, slope = dot(dot(units, hessian), units.T), dot(units, grad)
        low, high = (params.low - center) / sigma, (params.high - center) / sigma
        step = bounded_step(bend, slope, radius, low, high, dot(units, units.T))
        return self.metric.into(params.clip(center + sigma * step) - center)

    def revise(
        self,
        proposal: Proposal,
        before: Float[Array, ""],
        funs: Float[Array, " K"],
        good: Bool[Array, " K"],
    ) -> "QuadraticTrust":
        """The region after these values came; its metric is that of the last Hessian."""
        funs = jnp.where(good, funs, jnp.inf)
        best = jnp.argmin(funs)
        fun, reduction = funs[best], proposal.reduction[best]
        hessian = proposal.hessian
        metric, turn = self.metric.adapted(
            lambda v: dot(hessian, v), jnp.diagonal(hessian), jnp.zeros_like(fun)
        )
        usable = all_finite((metric, turn))
        still = Metric.of(jnp.ones_like(proposal.steps[0]), True)
        metric, turn = jax.tree.map(
            lambda a, b: jnp.where(usable, a, b), (metric, turn), (self.metric, still)
        )
        length = jnp.linalg.norm(turn.into(proposal.steps[best]))
        outcome = ratio_test(before, fun, reduction, self.fails)
        tried, failed, held, long, fails, _ = outcome
        radii = self.radius * powers_of_two(len(funs), length.dtype)
        # in the units that the step was made in
        moved = jnp.linalg.norm(proposal.steps[best])
        # a model of far points is made better before it is trusted less
        wait = proposal.poor & (fails < 2) & ~long
        lower = jnp.minimum(self.radius, length) * jnp.where(long, 0.1, 0.5)
        radius = jnp.where(failed & ~wait, lower, self.radius)
        radius = jnp.where(held, jnp.maximum(radius, 2 * length), radius)
        radius = jnp.where(~tried & ~self.improve, self.radius / 2, radius)
        return QuadraticTrust(
            metric=metric,
            radius=radius,
            hessian=turn.out(turn.out(hessian).T),
            improve=failed & proposal.poor,
            fails=fails,
            slow=jnp.where(fun < before, 0, self.slow + len(funs)).astype(fails.dtype),
            settled=settled(self.settled, outcome, moved, radii[best]),
            done=proposal.done,
        )
