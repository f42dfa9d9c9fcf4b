"""A Newton step under noise: how far to go, and what to make of the outcome."""

import math
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from smoothdiff._products import dot
from smoothdiff._solvers._metric import Metric
from smoothdiff._solvers._scalar_fit import ScalarFit
from smoothdiff._solvers._trust_region import truncated_cg

# a step is taken if the function falls by this share of the predicted reduction
_ACCEPT = 0.05
# a gradient as many times its standard error allows a step over the whole trust region; with less
# the radius falls steeply, so that samples are added up before the next step
_SURE, _STEEP = 2.0, 6
# the radius stays between these, in units of the distance of a sample
_LEAST, _MOST = 0.05, 16.0
# the model is faithful where the acceptance ratio is 1, give or take this much
_FAITH = 0.5
# how near to the boundary is at it
_EDGE = 0.99


class Trust(eqx.Module):
    """How far the model is believed.

    `width` is that of the samples relative to sigma, `radius` that of the trust region in widths,
    `reduction` the one that the model predicted for the last step. `lowest` is the lowest value so
    far, `stall` counts the steps in a row that led nowhere, and `insignificant` says that the last
    gradient was all noise.
    """

    width: Float[Array, ""]
    radius: Float[Array, ""]
    reduction: Float[Array, ""]
    lowest: Float[Array, ""]
    stall: Int[Array, ""]
    insignificant: Bool[Array, ""]

    @staticmethod
    def start(n: int, dtype) -> "Trust":
        """As wide as sigma: samples reach as far as the square root of n widths."""
        one = jnp.ones((), dtype)
        none = jnp.zeros((), jnp.int32)
        return Trust(one, math.sqrt(n) * one, 0 * one, jnp.inf * one, none, jnp.asarray(False))

    def times(self, factor: Float[Array, ""]) -> "Trust":
        """The same in a function with so many times the values."""
        scaled = self.reduction * factor, self.lowest * factor
        return eqx.tree_at(lambda t: (t.reduction, t.lowest), self, scaled)


class Step(NamedTuple):
    """A step in units of the width, and what speaks for it.

    `reduction` is the predicted one, `undamped` the length of the step if there were no noise, and
    `spread` the noise of the Newton step along it. At the `edge` the trust region cuts the step
    short. An `insignificant` step is zero, since the gradient is all noise, and on a `constant`
    function there is no gradient at all.
    """

    p: Float[Array, " n"]
    reduction: Float[Array, ""]
    undamped: Float[Array, ""]
    spread: Float[Array, ""]
    edge: Bool[Array, ""]
    insignificant: Bool[Array, ""]
    constant: Bool[Array, ""]


def outcome(
    model: ScalarFit, before: Float[Array, " n"], reduction: Float[Array, ""]
) -> tuple[Bool[Array, ""], Float[Array, ""]]:
    """Whether the step from `before` to here was good, and the ratio that says so.

    One model judges both ends, on the same samples; the noise of the difference counts in favour.

    Source: Sun and Nocedal 2023, A trust region method for noisy unconstrained optimization.
    """
    fell = model.value(before) - model.value(jnp.zeros_like(before))
    noise = model.difference_stderr(before)
    # after no step at all there is nothing to regret
    ratio = jnp.where(reduction > 0, (fell + noise) / (reduction + noise), 1)
    return ratio > _ACCEPT, ratio


def propose(
    model: ScalarFit,
    at: Float[Array, " n"],
    turn: Metric,
    radius: Float[Array, ""],
    hold: Callable[[Array], Array],
    confine: Callable[[Array], Array],
) -> Step:
    """The step that the model asks for at the place `at`, as far as it is to be believed.

    The step and the radius are in the turned metric. `hold` takes from a step what would
    move parameters that stay at their bounds, and `confine` gives what all bounds leave of it.
    """
    bend = model.curvature(at)

    def curvature(p: Array) -> Array:
        return hold(turn.out(bend(turn.out(hold(p)))))

    grad, error = model.grad(at), model.grad_stderr(at)
    size = jnp.linalg.norm(grad)
    # noise has no more dimensions than there are samples
    count = jnp.minimum(grad.size, jnp.sum(model.closeness > 0)).astype(grad.dtype)
    chance = jnp.sqrt(count) * model.slope_stderr(at, _ratio(grad, size))
    sure = jnp.minimum(1, _ratio(size, _SURE * chance) ** _STEEP)
    # positive-part James-Stein: what is within its noise says nothing. With fewer samples than
    # entries none of these can be told apart, and the gradient is shrunk as a whole.
    few = grad.size > len(model.points)
    doubt = _ratio(chance, size) if few else _ratio(error, jnp.abs(grad))
    believed = hold(turn.out(grad * jnp.maximum(0, 1 - doubt**2)))
    most = math.sqrt(grad.size)
    reach = jnp.minimum(radius * sure, most)
    p = confine(truncated_cg(curvature, believed, reach))
    reduction = -(dot(believed, p) + dot(p, curvature(p)) / 2)
    # bounds can leave of a step what is worse than none
    p = jnp.where(reduction > 0, p, 0)
    undamped = truncated_cg(curvature, hold(turn.out(grad)), jnp.minimum(radius, most))
    bent = jnp.abs(dot(undamped, curvature(undamped)))
    ahead = turn.out(undamped)
    error_ahead = model.slope_stderr(at, _ratio(ahead, jnp.linalg.norm(ahead)))
    return Step(
        p=p,
        reduction=jnp.maximum(reduction, 0),
        undamped=jnp.linalg.norm(undamped),
        spread=_ratio(error_ahead * dot(undamped, undamped), bent),
        edge=jnp.linalg.norm(p) >= _EDGE * reach,
        insignificant=~jnp.any(believed != 0),
        constant=size == 0,
    )


def _ratio(a: Array, b: Array) -> Array:
    """a / b, and huge rather than NaN where b is zero."""
    return a / jnp.maximum(b, jnp.finfo(b.dtype).tiny)


def revise(
    trust: Trust,
    step: Step,
    good: Bool[Array, ""],
    ratio: Float[Array, ""],
    value: Float[Array, ""],
    small: Bool[Array, ""],
    level: Bool[Array, ""],
    adaptive: bool,
) -> Trust:
    """The trust for the next step; the width stays as it is unless it is adaptive.

    The width goes to the length of the Newton step, or to its noise if that is more: where samples
    are too few to tell, narrower ones would tell even less. Where all is noise it grows. Where the
    function is constant, or the last samples are all `level`, it grows beyond sigma: they are
    narrower than what there is to see, as on the lowest of some stairs. A step has led somewhere if
    the `value` where it started is the lowest so far, unless the next one is insignificant or
    `small`.
    """
    most = math.sqrt(step.p.size)
    length = jnp.linalg.norm(step.p)
    radius = trust.radius
    faithful = step.edge & (jnp.abs(ratio - 1) < _FAITH)
    change = jnp.where(faithful, 2.0, jnp.where(~good | (ratio < 0.25), 0.5, 1.0))
    width, factor = trust.width, jnp.ones_like(radius)
    if adaptive:
        need = jnp.maximum(jnp.minimum(step.undamped, radius) / most, step.spread)
        factor = jnp.where(step.edge & good, 1, jnp.clip(need, 0.25, 1))
        factor = jnp.where(length >= _EDGE * most, 1.5, factor)
        factor = jnp.where(step.insignificant, jnp.clip(need, 0.5, 1.2), factor)
        factor = jnp.minimum(factor, jnp.maximum(1 / width, 1))
        factor = jnp.where(step.constant | level, 2, factor)
    # the radius is in widths, and the region shall not shrink only because the width does
    radius = jnp.maximum(radius * change, _LEAST * most) / jnp.minimum(factor, 1)
    return Trust(
        width=width * factor,
        radius=jnp.minimum(radius, _MOST * most),
        reduction=step.reduction,
        lowest=jnp.minimum(trust.lowest, value),
        stall=jnp.where(step.insignificant | small | (value >= trust.lowest), trust.stall + 1, 0),
        insignificant=step.insignificant,
    )
