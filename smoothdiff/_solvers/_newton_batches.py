"""Newton-CG by batches: many parameters, or a sigma that is a schedule."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from smoothdiff._batch import Batch, evaluate
from smoothdiff._estimate import combine
from smoothdiff._named_baselines import as_baseline
from smoothdiff._params import Params, take_apart
from smoothdiff._samplers import Sobol
from smoothdiff._seen import watched
from smoothdiff._solvers._base import (
    Progress,
    all_finite,
    is_small,
    read_options,
    smoothed_params,
)
from smoothdiff._solvers._history import History
from smoothdiff._solvers._judgement import judged, judging, one_by_one
from smoothdiff._solvers._metric import Metric
from smoothdiff._solvers._random_numbers import in_step
from smoothdiff._solvers._ratio_test import are_level
from smoothdiff._solvers._regression_step import Center
from smoothdiff._solvers._restarts import Restarts
from smoothdiff._solvers._where import where
from smoothdiff._stderr import value_stderr

# the most entries of the points that are kept by default, 128 MB in float64
_MEMORY = 2**24
# ... and otherwise from so many to so many of them
FEWEST, MOST = 40, 512
# by default a search ends after so many steps in a row that led nowhere
_PATIENCE = 30


class NewtonBatchState(eqx.Module):
    """The state of a run."""

    progress: Progress
    center: Center
    history: History
    restarts: Restarts | None


def evaluations_per_step(solver: Any, y: PyTree[Array]) -> int:
    """One batch."""
    if solver.num_samples is not None:
        return solver.num_samples
    size = sum(leaf.size for leaf in jax.tree.leaves(y))
    return 4 + int(3 * math.log(size))


def final_evaluations(solver: Any, y: PyTree[Array]) -> int:
    """Those that judge the start, the last point, the accepted one and the best estimate."""
    return judging(evaluations_per_step(solver, y), new=4)


def over(solver: Any, state: NewtonBatchState) -> Array:
    """Whether so many steps in a row led nowhere."""
    return state.center.trust.stall >= (solver.patience or _PATIENCE)


def _metric(solver: Any, metric: Metric, params: Params) -> Metric:
    """That of the search, unless a schedule says how wide to sample."""
    return Metric.of(params.sigma, False) if callable(solver.sigma) else metric


def _batch(solver, fn, y, args, params: Params, center: Center, step, options) -> Batch:
    """One batch around y; its points are in units of the width."""
    unit = take_apart(jnp.zeros_like(params.theta), 1.0, None)
    args = in_step(args, options, step)

    def fun(u: Array, _: list) -> tuple[Array, PyTree]:
        return watched(fn, args)(params.layout.tree(center.sample(params, u)))

    sampler = solver.sampler or Sobol()
    batch = evaluate(
        fun,
        unit,
        jax.random.fold_in(read_options(options)[0], step),
        num_samples=evaluations_per_step(solver, y),
        sampler=sampler,
        baseline=as_baseline("mean"),
        batch_size=None,
        nonfinite=solver.nonfinite,
    )
    if batch.log_ratio is not None or not sampler.gaussian:
        raise ValueError(f"{sampler} has weights: NewtonCG needs points that are normal")
    return batch


def _first(solver: Any, params: Params, theta: Array) -> Center:
    return Center.start(theta, Metric.of(params.sigma, not callable(solver.sigma)))


def init(solver: Any, y: PyTree[Array], options: dict, dtype: Any) -> NewtonBatchState:
    """Checks what can be looked at; evaluates nothing."""
    params = smoothed_params(solver, y, jnp.asarray(0, jnp.int32), options)
    theta, n = params.theta, params.theta.size
    usual = min(max((n + 1) * (n + 2), FEWEST), MOST, max(_MEMORY // n, 64))
    length = max(solver.history or usual, evaluations_per_step(solver, y))
    center = _first(solver, params, theta)
    kernel = center.metric, center.trust.width
    restarts = Restarts.start(solver.restarts, theta, kernel)
    history = History.empty(length, n, 1, theta.dtype)
    return NewtonBatchState(Progress.start(y, dtype), center, history, restarts)


def step(
    solver: Any, fn: Any, y: PyTree[Array], args: PyTree, options: dict, state: NewtonBatchState
) -> tuple[PyTree[Array], NewtonBatchState, PyTree]:
    """One batch, one Newton step from all samples that are kept."""
    progress, center = state.progress, state.center
    params = smoothed_params(solver, y, progress.step, options)
    adaptive = not callable(solver.sigma)
    metric = _metric(solver, center.metric, params)
    center = Center(params.theta, center.accepted, metric, center.trust)
    batch = _batch(solver, fn, y, args, params, center, progress.step, options)
    seen = batch.aux.lowest()
    z = batch.draws.map(lambda z, _: z)
    points = jax.vmap(lambda u: center.sample(params, u))(z)
    good = jnp.isfinite(batch.values) if batch.valid is None else batch.valid
    values = batch.values.astype(points.dtype)
    history = state.history.after(points, values[:, None], values, good, jnp.asarray(len(z)))

    after, value, stderr = center.stepped(
        params,
        history.points,
        history.funs,
        history.valid,
        adaptive,
        returns=jnp.asarray(False),
        level=are_level(values, good),
        small=lambda move: is_small(solver, params.layout.tree(move), y),
    )
    new_y = params.layout.tree(after.theta)
    finite = all_finite((batch.values if batch.valid is None else batch.scale, after.theta))
    going = where(finite, (new_y, after, history), (y, state.center, state.history))
    width = center.trust.width * metric.widest()
    progress = progress.after(y, value, stderr, width, len(z), finite, seen)
    restarts = state.restarts
    if restarts is not None:
        lowest = progress.best_smoothed < state.progress.best_smoothed
        restarts = restarts.after(lowest, (metric, center.trust.width))
        first = _first(solver, params, restarts.theta), jax.tree.map(jnp.zeros_like, history)
        stall = going[1].trust.stall >= (solver.patience or _PATIENCE)
        start = params.layout.tree(restarts.theta)
        going, restarts = restarts.next(stall, going, (start, *first))
    new_y, after, history = going
    # the function was never evaluated at y itself, so its aux is that of a sample near y
    return new_y, NewtonBatchState(progress, after, history, restarts), seen.aux


def judge(
    solver: Any, fn: Any, y: PyTree[Array], args: PyTree, options: dict, state: NewtonBatchState
) -> tuple[PyTree[Array], dict[str, Array]]:
    """Judges all that was seen, the start, the last two points and the best estimate."""
    progress, center = state.progress, state.center
    # with restarts, on the width on which the lowest estimate was made
    kernel = center.metric, center.trust.width
    turned, wide = kernel if state.restarts is None else state.restarts.kernel

    def estimate(y):
        params = smoothed_params(solver, y, progress.step, options)
        trust = eqx.tree_at(lambda t: t.width, center.trust, wide)
        around = Center(params.theta, params.theta, _metric(solver, turned, params), trust)
        batch = _batch(solver, fn, y, args, params, around, progress.step, options)
        value = combine(batch, jnp.zeros_like(params.theta))
        return value, value_stderr(batch, value), batch.aux.lowest()

    params = smoothed_params(solver, y, progress.step, options)
    accepted = params.layout.tree(center.accepted)
    new = y, accepted, progress.best_y, progress.start_y
    values = one_by_one(fn, args, options, None)
    return judged(progress, values, estimate, evaluations_per_step(solver, y), new)
