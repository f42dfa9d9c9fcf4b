"""A Newton step from a regression over samples that are kept: where to sample next, how wide."""

import math
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from smoothdiff._params import Params
from smoothdiff._solvers._averaging import apart
from smoothdiff._solvers._metric import Metric
from smoothdiff._solvers._noisy_step import Trust, outcome, propose, revise
from smoothdiff._solvers._ratio_test import nothing
from smoothdiff._solvers._scalar_fit import ScalarFit, fit
from smoothdiff._solvers._stages import Sizes
from smoothdiff._solvers._where import where

# how strongly the noise of the Hessian's eigenvalues counts in the metric
_CAUTION = 6.0
# after so many steps in a row that lead nowhere, every second one goes back to the lowest sample,
# with samples so much narrower
_LOST, _NARROWER = 6, 0.6
# of the exponent of the largest number: beyond, squares of numbers and their sums are none
_EXTREME = 0.4


class Center(eqx.Module):
    """Where samples are drawn, `theta`, and how: the metric, the width and the trust in them.

    `accepted` is the last point that was better than the one before.
    """

    theta: Float[Array, " n"]
    accepted: Float[Array, " n"]
    metric: Metric
    trust: Trust

    @staticmethod
    def start(theta: Float[Array, " n"], metric: Metric) -> "Center":
        """Nothing is known, and the samples are as wide as the metric."""
        return Center(theta, theta, metric, Trust.start(theta.size, theta.dtype))

    def moved(self, theta: Float[Array, " n"], radius: Float[Array, ""]) -> "Center":
        """The same samples, around another point, as wide as the radius if it is so far away."""
        trust = self.trust
        length = jnp.linalg.norm(self.metric.into(theta - self.theta))
        still = jnp.zeros_like(trust.reduction), jnp.zeros_like(trust.stall)
        new = *still, jnp.maximum(trust.width, jnp.minimum(length, radius))
        trust = eqx.tree_at(lambda t: (t.reduction, t.stall, t.width), trust, new)
        return Center(theta, theta, self.metric, trust)

    def lost(self, sizes: Sizes) -> Bool[Array, ""]:
        """Whether rounds led nowhere for too long, or have no width any more."""
        trust = self.trust
        return (trust.stall * sizes.first >= sizes.patience) | nothing(trust.width)

    def sample(self, params: Params, z: Float[Array, " n"]) -> Float[Array, " n"]:
        """The sample for a standard normal point, within the bounds."""
        return _bounded(params, self.metric, self.theta, z, self.trust.width, mirror=True)

    def stepped(
        self,
        params: Params,
        points: Float[Array, "m n"],
        values: Float[Array, " m"],
        valid: Bool[Array, " m"],
        adaptive: bool,
        returns: Bool[Array, ""],
        level: Bool[Array, ""],
        small: Callable[[Array], Array] = lambda move: jnp.asarray(False),
        rounds: Int[Array, " m"] | None = None,
    ) -> tuple["Center", Float[Array, ""], Float[Array, ""]]:
        """The next center; the smoothed function at this one, and its standard error.

        It `returns` to the lowest sample from a step that led nowhere, or not. `level` says whether
        the last samples all have one value, `small` whether a step is too small to lead anywhere.
        Where the function takes a key, another one in each of the `rounds`, samples are no nearer
        to each other than noise allows.
        """
        unit = _unit(values, valid)
        theta, metric, trust = self.theta, self.metric, self.trust.times(1 / unit)
        values = values / unit
        model = fit(metric.into(points - theta[None]) / trust.width, values, valid, rounds)
        before = metric.into(self.accepted - theta) / trust.width
        good, ratio = outcome(model, before, trust.reduction)
        at, base = jnp.where(good, 0, before), jnp.where(good, theta, self.accepted)
        turned, turn = _adapted(metric, model, at) if adaptive else (metric, metric.unit())

        active = _held(params, base, metric.slope(model.grad(at)), trust.width * metric.widest())
        hold = (lambda p: p) if active is None else turned.holding(active)

        def confine(p: Array) -> Array:
            if active is None:
                return p
            x = _bounded(params, turned, base, p, trust.width, mirror=False)
            return turned.into(x - base) / trust.width

        step = propose(model, at, turn, trust.radius, hold, confine)
        x = params.clip(base + trust.width * turned.out(step.p))
        if active is not None:
            # to the last bit, or it would not be at its bound in the next step
            x = jnp.where(active, base, x)

        here = jnp.zeros_like(at)
        known = jnp.where(valid, values, jnp.inf)
        lowest = jnp.argmin(known)
        # an estimate below all samples is an error of the model
        value = jnp.maximum(model.value(here), known[lowest])
        new = revise(trust, step, good, ratio, value, small(x - base), level, adaptive)
        if rounds is not None:
            wide = jnp.maximum(new.width, apart(trust.width, model.noise, model.spread(here)))
            radius = new.radius * new.width / wide
            new = eqx.tree_at(lambda t: (t.width, t.radius), new, (wide, radius))
        back = (new.stall >= _LOST) & (new.stall % 2 == 0) & returns
        x, base = (jnp.where(back, points[lowest], a) for a in (x, base))
        narrower = _NARROWER * trust.width, jnp.zeros_like(new.reduction)
        there = eqx.tree_at(lambda t: (t.width, t.reduction), new, narrower)
        new = where(back, there, new)
        after = Center(x, base, turned, new.times(unit))
        return after, value * unit, model.value_stderr(here) * unit


def _unit(values: Float[Array, " m"], valid: Bool[Array, " m"]) -> Float[Array, ""]:
    """In what values are counted: one, unless squares of how they differ would be no numbers."""
    lowest = jnp.min(jnp.where(valid, values, jnp.inf))
    typical = jnp.nanmedian(jnp.where(valid, values - lowest, jnp.nan))
    limit = float(jnp.finfo(values.dtype).max) ** _EXTREME
    extreme = jnp.isfinite(typical) & (typical >= jnp.finfo(values.dtype).tiny)
    extreme &= (typical > limit) | (typical < 1 / limit)
    return jnp.where(extreme, typical, jnp.ones_like(typical))


def _adapted(metric: Metric, model: ScalarFit, at: Array) -> tuple[Metric, Metric]:
    """The metric of the model's Hessian, and the change to it."""
    grad = model.grad(at)
    size = jnp.linalg.norm(grad)
    along = grad / jnp.maximum(size, jnp.finfo(grad.dtype).tiny)
    noise = _CAUTION * math.sqrt(grad.size) * model.curvature_stderr(at, along)
    return metric.adapted(model.curvature(at), model.curvature_diagonal(at), noise)


def _bounded(
    params: Params, metric: Metric, base: Array, u: Array, width: Array, mirror: bool
) -> Array:
    """The point u widths from `base`, within the bounds if there are any."""
    if params.bounds is None:
        return base + metric.out(width * u)
    return metric.bounded(base, width * u, *params.bounds, mirror)


def _held(params: Params, x: Array, slope: Array, width: Array) -> Array | None:
    """Which parameters are at a bound that the descent would cross; None without bounds."""
    if params.bounds is None:
        return None
    low, high = params.bounds
    # a step to a bound ends there but for rounding
    near = 100 * jnp.finfo(x.dtype).eps * (jnp.abs(x) + width)
    return ((x <= low + near) & (slope > 0)) | ((x >= high - near) & (slope < 0))
