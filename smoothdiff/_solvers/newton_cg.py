"""Newton steps on the smoothed function, by truncated conjugate gradients, from samples kept."""

import math
from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree

from smoothdiff._batch import Batch, evaluate
from smoothdiff._estimate import combine
from smoothdiff._named_baselines import as_baseline
from smoothdiff._params import Params, take_apart
from smoothdiff._samplers import AbstractSampler, Sobol
from smoothdiff._seen import watched
from smoothdiff._solvers._base import (
    AbstractSmoothSolver,
    Progress,
    all_finite,
    promotion,
    read_options,
    smoothed_params,
    stopped,
    unless_failed,
)
from smoothdiff._solvers._judgement import judged, judging, one_by_one
from smoothdiff._solvers._metric import Metric
from smoothdiff._solvers._noisy_step import outcome, propose, revise
from smoothdiff._solvers._restarts import Restarts, check_restarts
from smoothdiff._solvers._scalar_fit import ScalarFit, fit
from smoothdiff._solvers._search import Search
from smoothdiff._stderr import value_stderr

# the most entries of the points that are kept by default, 128 MB in float64
_MEMORY = 2**24
# the fewest samples that are kept by default: with few parameters more pay than the curvature needs
_FEWEST = 40
# how strongly the noise of the Hessian's eigenvalues counts in the metric
_CAUTION = 6.0


class NewtonCGState(eqx.Module):
    """The state of `NewtonCG`."""

    progress: Progress
    search: Search
    restarts: Restarts | None


class NewtonCG(AbstractSmoothSolver, optx.AbstractMinimiser):
    r"""Newton's method on the smoothed function: each step costs one small batch of evaluations.

    $$ \min_p \; \nabla F \cdot p + \tfrac12 p \cdot \nabla^2 F \, p, \qquad
       \|p\|_{M^{-1}} \le \Delta $$

    The model of F comes from a regression over the samples of this and of earlier steps, which
    gives the smoothed value, gradient and Hessian-vector products in closed form, with standard
    errors. A truncated conjugate-gradient method minimises it within the trust region; it needs no
    evaluation, and goes down directions of negative curvature to the boundary. What is known of the
    noise decides how far to go: entries of the gradient are shrunk by their standard errors, the
    radius by that of the whole gradient, and the test of the last step, made on the new batch, is
    relaxed by the standard error of the difference.

    With sigma as a number or a pytree the width adapts: it shrinks to the length of the Newton step
    as far as the noise of that step allows, grows where there is nothing but noise or a plateau,
    and takes the shape of the Hessian, directions included up to 64 parameters. So sigma says where
    to begin. With an optax schedule the width is the schedule's.

    Bounds are never left. A sample beyond them is clamped or, where that would throw it out of a
    narrow valley, pulled back along its ray, and the regression takes it where it was evaluated.
    (The transforms weight unclamped points instead; for a fit that breaks the model.)

    Args:
        sigma: the smoothing width in the units of the parameters: a number or a pytree like the
            parameters to begin with; or an optax schedule, a function from the number of the step
            to a number, that is followed.
        num_samples: evaluations a step; by default 4 + 3 log n for n parameters.
        history: how many samples are kept, by default (n + 1)(n + 2), but from 40 to 512, and less
            where they would take more than 128 MB.
        sampler: where to sample, one whose points are normal.
        nonfinite: "propagate" a sample that is NaN or infinite, which ends the run with an error,
            or "drop" it.
        rtol: relative tolerance: a step is small if it is below `atol + rtol * norm(y)`.
        atol: absolute tolerance.
        norm: the norm of steps and iterates.
        patience: how many steps in a row that lead nowhere end the search: the estimate is not the
            lowest so far, or the gradient is all noise, or the step is small.
        restarts: how many searches may follow, each from the first point and with the first sigma,
            but with other random numbers: for functions with several minima. The best point of all
            is returned. A schedule of sigma goes on where it was.

    Raises:
        ValueError: fewer than two samples or kept ones, a patience of no step, negative restarts,
            another `nonfinite`; and, when it runs, a leaf without a sigma, or a sampler with
            weights.

    Example:
        >>> import jax, jax.numpy as jnp, optimistix as optx, smoothdiff as sd
        >>> plateaus = lambda y, args: jnp.sum(jnp.floor(8 * (y - 1) ** 2))
        >>> solver = sd.NewtonCG(0.5)
        >>> solution = optx.minimise(
        ...     plateaus, solver, jnp.zeros(2), options={"key": jax.random.key(0)},
        ...     max_steps=20, throw=False
        ... )
        >>> [round(float(y)) for y in solution.value]
        [1, 1]

    Source: Stochastic Gradient Estimation for Higher-order Differentiable Rendering, section 4, for
    Newton-CG on sampled derivatives; Steihaug 1983 for the inner solver; Sun and Nocedal 2023 for
    the relaxed test.
    """

    sigma: PyTree
    num_samples: int | None
    history: int | None
    sampler: AbstractSampler
    nonfinite: Literal["propagate", "drop"]
    rtol: float
    atol: float
    norm: Callable[[PyTree], Float[Array, ""]]
    patience: int
    restarts: int

    def __init__(
        self,
        sigma: PyTree,
        *,
        num_samples: int | None = None,
        history: int | None = None,
        sampler: AbstractSampler = Sobol(),  # noqa: B008 (a frozen module)
        nonfinite: Literal["propagate", "drop"] = "propagate",
        rtol: float = 0.0,
        atol: float = 0.0,
        norm: Callable[[PyTree], Float[Array, ""]] = optx.max_norm,
        patience: int = 30,
        restarts: int = 0,
    ):
        for name, value in (("num_samples", num_samples), ("history", history)):
            if value is not None and value < 2:
                raise ValueError(f"{name} must be at least 2, or None for the default: {value}")
        check_restarts(patience, restarts)
        if nonfinite not in ("propagate", "drop"):
            raise ValueError(f'nonfinite must be "propagate" or "drop", not {nonfinite!r}')
        self.sigma = sigma
        self.num_samples = num_samples
        self.history = history
        self.sampler = sampler
        self.nonfinite = nonfinite
        self.rtol = rtol
        self.atol = atol
        self.norm = norm
        self.patience = patience
        self.restarts = restarts

    @property
    def _adaptive(self) -> bool:
        return not callable(self.sigma)

    def _metric(self, metric: Metric, params: Params) -> Metric:
        """That of the search, unless a schedule says how wide to sample."""
        return metric if self._adaptive else Metric.of(params.sigma, False)

    def evaluations_per_step(self, y: PyTree[Array]) -> int:
        """One batch."""
        if self.num_samples is not None:
            return self.num_samples
        size = sum(leaf.size for leaf in jax.tree.leaves(y))
        return 4 + int(3 * math.log(size))

    def final_evaluations(self, y: PyTree[Array]) -> int:
        """Those that judge the start, the last point, the accepted one and the best estimate."""
        return judging(self.evaluations_per_step(y), new=4)

    def _kept(self, y: PyTree[Array], n: int) -> int:
        usual = min(max((n + 1) * (n + 2), _FEWEST), 512, max(_MEMORY // n, 64))
        return max(usual if self.history is None else self.history, self.evaluations_per_step(y))

    def _batch(self, fn, y, args, params: Params, metric: Metric, width, step, options) -> Batch:
        """One batch around y; its points are in units of the width."""
        unit = take_apart(jnp.zeros_like(params.theta), 1.0, None)

        def fun(u: Array, _: list) -> tuple[Array, PyTree]:
            x = _bounded(params, metric, params.theta, u, width, mirror=True)
            return watched(fn, args)(params.layout.tree(x))

        batch = evaluate(
            fun,
            unit,
            jax.random.fold_in(read_options(options)[0], step),
            num_samples=self.evaluations_per_step(y),
            sampler=self.sampler,
            baseline=as_baseline("mean"),
            batch_size=None,
            nonfinite=self.nonfinite,
        )
        if batch.log_ratio is not None or not self.sampler.gaussian:
            raise ValueError(f"{self.sampler} has weights: NewtonCG needs points that are normal")
        return batch

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> NewtonCGState:
        """Checks what can be looked at; evaluates nothing."""
        step = jnp.asarray(0, jnp.int32)
        params = smoothed_params(self, y, step, options)
        theta, metric = params.theta, Metric.of(params.sigma, self._adaptive)
        search = Search.start(theta, metric, self._kept(y, theta.size))
        restarts = Restarts.start(self.restarts, theta, (metric, search.trust.width))
        return NewtonCGState(Progress.start(y, f_struct.dtype), search, restarts)

    def step(self, fn, y, args, options, state: NewtonCGState, tags):
        """One batch, one Newton step from all samples that are kept."""
        progress, search, trust = state.progress, state.search, state.search.trust
        params = smoothed_params(self, y, progress.step, options)
        theta = params.theta
        metric = self._metric(search.metric, params)
        batch = self._batch(fn, y, args, params, metric, trust.width, progress.step, options)
        seen = batch.aux.lowest()
        z = batch.draws.map(lambda z, _: z)
        points = jax.vmap(lambda u: _bounded(params, metric, theta, u, trust.width, mirror=True))(z)
        fresh = jnp.isfinite(batch.values) if batch.valid is None else batch.valid
        kept = search.keeping(points, batch.values, fresh)
        model = fit(metric.into(kept.points - theta[None]) / trust.width, kept.values, kept.valid)

        before = metric.into(search.accepted - theta) / trust.width
        good, ratio = outcome(model, before, trust.promised)
        at, base = jnp.where(good, 0, before), jnp.where(good, theta, search.accepted)
        new_metric, turn = (
            _adapted(metric, model, at) if self._adaptive else (metric, metric.unit())
        )

        held = _held(params, base, metric.slope(model.grad(at)), trust.width * metric.widest())
        hold = (lambda p: p) if held is None else new_metric.holding(held)

        def confine(p: Array) -> Array:
            if held is None:
                return p
            x = _bounded(params, new_metric, base, p, trust.width, mirror=False)
            return new_metric.into(x - base) / trust.width

        step = propose(model, at, turn, trust.radius, hold, confine)
        x = params.clip(base + trust.width * new_metric.out(step.p))
        if held is not None:
            # to the last bit, or it would not be at its bound in the next step
            x = jnp.where(held, base, x)
        new_y = params.layout.tree(x)
        with promotion():
            length = self.norm(params.layout.tree(x - base))
            small = length < self.atol + self.rtol * self.norm(y)
        here = jnp.zeros_like(at)
        value = model.value(here)
        new_trust = revise(trust, step, good, ratio, value, small, self._adaptive)
        finite = all_finite((batch.values if batch.valid is None else batch.scale, x))
        new_y, new_search = unless_failed(
            finite, (new_y, kept.moved(base, new_metric, new_trust)), (y, search)
        )
        progress = progress.after(
            y,
            value,
            model.value_stderr(here),
            trust.width * metric.widest(),
            len(z),
            finite,
            seen,
        )
        restarts = state.restarts
        if restarts is not None:
            lowest = progress.best_fun < state.progress.best_fun
            restarts = restarts.after(lowest, (metric, trust.width))
            as_given = Metric.of(params.sigma, self._adaptive)
            first = Search.start(restarts.theta, as_given, len(new_search.valid))
            start = params.layout.tree(restarts.theta)
            (new_y, new_search), restarts = restarts.next(
                new_search.done(self.patience), (new_y, new_search), (start, first)
            )
        # the function was never evaluated at y itself, so its aux is that of a sample near y
        return new_y, NewtonCGState(progress, new_search, restarts), seen.aux

    def terminate(self, fn, y, args, options, state, tags) -> tuple[Bool[Array, ""], optx.RESULTS]:
        """After `patience` steps in a row that led nowhere, or a failed step."""
        return stopped(state.progress, state.search.done(self.patience))

    def reason(self, state: NewtonCGState) -> str:
        """Small steps, or a gradient that is all noise however many samples there are."""
        return "noise" if state.search.trust.blind else "converged"

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Judges all that was seen, the start, the last two points and the best estimate."""
        progress, search = state.progress, state.search
        # with restarts, on the width on which the lowest estimate was made
        kernel = search.metric, search.trust.width
        turned, wide = kernel if state.restarts is None else state.restarts.kernel

        def estimate(y):
            params = smoothed_params(self, y, progress.step, options)
            metric = self._metric(turned, params)
            batch = self._batch(fn, y, args, params, metric, wide, progress.step, options)
            value = combine(batch, jnp.zeros_like(params.theta))
            return value, value_stderr(batch, value), batch.aux.lowest()

        params = smoothed_params(self, y, progress.step, options)
        accepted = params.layout.tree(search.accepted)
        new = y, accepted, progress.best_y, progress.start_y
        values = one_by_one(fn, args, None)
        y, stats = judged(progress, values, estimate, self.evaluations_per_step(y), new)
        return y, aux, stats


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
    if params.low is None or params.high is None:
        return base + metric.out(width * u)
    return metric.bounded(base, width * u, params.low, params.high, mirror)


def _held(params: Params, x: Array, slope: Array, width: Array) -> Array | None:
    """Which parameters are at a bound that the descent would cross; None without bounds."""
    if params.low is None or params.high is None:
        return None
    # a step to a bound ends there but for rounding
    near = 100 * jnp.finfo(x.dtype).eps * (jnp.abs(x) + width)
    return ((x <= params.low + near) & (slope > 0)) | ((x >= params.high - near) & (slope < 0))
