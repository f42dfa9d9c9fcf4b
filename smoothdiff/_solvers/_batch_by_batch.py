"""Gauss-Newton by batches: many parameters, or a sigma that is a schedule."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from smoothdiff._layout import layout_of
from smoothdiff._params import Params
from smoothdiff._samplers import Gaussian, Sobol
from smoothdiff._seen import Seen, kept
from smoothdiff._solvers._base import (
    Progress,
    all_finite,
    is_small,
    read_options,
    smoothed_params,
)
from smoothdiff._solvers._batch_search import BatchSearch
from smoothdiff._solvers._evaluator import Evaluator, half_squares
from smoothdiff._solvers._history import History
from smoothdiff._solvers._judgement import judging
from smoothdiff._solvers._local_steps import TRIED, steps_to_try
from smoothdiff._solvers._parameter_regression import gauss_newton_step
from smoothdiff._solvers._random_numbers import in_step
from smoothdiff._solvers._residual_batch import (
    ResidualBatch,
    around,
    judge_rows,
)
from smoothdiff._solvers._restarts import Restarts
from smoothdiff._solvers._where import where
from smoothdiff._solvers._wide_rounds import LONGEST, further, next_scale, sides_of

# evaluations a step of a problem with many parameters
_MOST = 96
# from so many parameters on, several steps are evaluated and the best is taken
MANY = 100
# with restarts, a search ends after so many steps in a row without a lower estimate
_PATIENCE = 30


class BatchState(eqx.Module):
    """The state of a run."""

    progress: Progress
    search: BatchSearch
    restarts: Restarts | None

    def jumped(self, distance: Float[Array, ""]) -> "BatchState":
        """After a jump of so many sigmas the next samples are as far around, up to one sigma."""
        scale = self.search.scale
        scale = jnp.clip(distance, scale, jnp.maximum(scale, 1))
        return dataclasses.replace(self, search=dataclasses.replace(self.search, scale=scale))


def sizes_of(solver: Any, y: PyTree[Array]) -> tuple[int, int, int]:
    """Samples of a first batch, and of a later one; and how many steps are tried."""
    n = sum(leaf.size for leaf in jax.tree.leaves(y))
    first = solver.num_samples or max(int(4 + 3 * math.log(n)), min(n // 2, _MOST))
    # what the history has need not be seen again
    later = first if solver.num_samples else min(first, max(2, n))
    tried = TRIED if n >= MANY and first >= 3 * TRIED else 0
    return first - tried, later - tried, tried


def evaluations_per_step(solver: Any, y: PyTree[Array]) -> int:
    """One batch, as large as the first, and the steps that are tried."""
    first, _, tried = sizes_of(solver, y)
    return first + tried


def final_evaluations(solver: Any, y: PyTree[Array]) -> int:
    """Those that judge the last iterate, and the start and the best estimate again."""
    return judging(evaluations_per_step(solver, y), new=1, old=2)


def over(solver: Any, state: BatchState) -> Array:
    """Whether the last steps were small."""
    return state.search.converged()


def _points(solver: Any, params: Params, key: Array, sigma: Array, count: int) -> Array:
    # few Sobol points are all but the same in some pairs of very many dimensions
    sampler = solver.sampler or (Sobol() if params.theta.size < MANY else Gaussian())
    return around(params, sampler, key, sigma, count)


def _batch(
    solver: Any,
    params: Params,
    residuals: Evaluator,
    key: Array,
    sigma: Array,
    y: PyTree,
    search: BatchSearch,
) -> tuple[ResidualBatch, PyTree]:
    """The iterate and samples around it, fewer of them once they differ; and aux.

    With few parameters one of the samples makes way for a point further on.
    """
    first, later, tried = sizes_of(solver, y)
    points = jnp.concatenate([params.theta[None], _points(solver, params, key, sigma, first - 1)])
    drawn = jnp.ones(first, bool)
    if not tried:
        step, worth = further(search.move, sigma)
        beyond = params.clip(params.theta + step)
        points = kept(points.at[1].set(jnp.where(worth, beyond, points[1])))
        drawn = drawn.at[1].set(~worth)

    def evaluate(count: int) -> tuple[Array, PyTree]:
        rows, aux = residuals(points[:count])
        return jnp.pad(rows, ((0, first - count), (0, 0))), aux

    if later == first:
        count, (rows, aux) = jnp.asarray(first), evaluate(first)
    else:
        count = jnp.where(search.seen, later, first)
        rows, aux = jax.lax.cond(search.seen, lambda: evaluate(later), lambda: evaluate(first))
    return ResidualBatch.of(points, rows, count, drawn), aux


def init(solver: Any, y: PyTree[Array], options: dict[str, Any], size: int) -> BatchState:
    """Nothing is known of so many residuals."""
    params = smoothed_params(solver, y, jnp.asarray(0, jnp.int32), options)
    n, dtype = params.theta.size, params.theta.dtype
    first, *_ = sizes_of(solver, y)
    if solver.history is None:
        length = max(min(max(12 * n, 32), 256), (3 if n < MANY else 4) * first)
    else:
        length = max(solver.history, first)
    search = BatchSearch.start(History.empty(length, n, size, dtype))
    restarts = Restarts.start(solver.restarts, params.theta, search.scale)
    return BatchState(Progress.start(y, dtype), search, restarts)


def step(
    solver: Any, fn: Any, y: PyTree[Array], args: PyTree, options: dict, state: BatchState
) -> tuple[PyTree[Array], BatchState, PyTree]:
    """One batch, one regression, one step."""
    progress, search = state.progress, state.search
    params = smoothed_params(solver, y, progress.step, options)
    numbers = in_step(args, options, progress.step)
    residuals = _evaluator(solver, fn, numbers, y)
    key = jax.random.fold_in(read_options(options)[0], progress.step)
    count, _, tried = sizes_of(solver, y)
    sigma = params.sigma * search.scale
    batch, aux = _batch(solver, params, residuals, key, sigma, y, search)
    history = search.history.after(
        batch.points, batch.rows, half_squares(batch.rows), batch.good, batch.count
    )

    center, here = params.theta, batch.rows[0]
    if not tried:
        center, here = history.lowest(center, batch.here())
    u = (history.points - center[None]) / sigma[None]
    sides = sides_of(params, center, sigma)
    # steps that are evaluated are so within the bounds
    known = (None, None) if tried else sides
    move, error = gauss_newton_step(u, history.rows, history.valid, *known)
    longest = jnp.max(jnp.abs(move))
    move = move / jnp.maximum(1, longest / LONGEST)
    point, there = batch.lowest()
    if tried:
        steps = steps_to_try(move, u, history.rows, history.valid, here, count, *sides)
        move, longest, end, at_end = _best(params, residuals, sigma, steps, here)
        point, there = jnp.where(at_end < there, end, point), jnp.minimum(there, at_end)
    theta = params.clip(center + sigma * move)
    same = batch.same()
    scale = search.scale
    if not callable(solver.sigma):
        # a few that are the same call for more of them first
        flat = same & (batch.count == count)
        error = jnp.sqrt(jnp.mean(error**2))
        scale = next_scale(scale, flat, history, here, u, error, longest / LONGEST)

    fun, stderr = batch.loss()
    new_y = params.layout.tree(theta)
    small = is_small(solver, params.layout.tree(jnp.abs(theta - params.theta) + sigma), y)
    finite = batch.enough(solver.nonfinite) & all_finite((fun, theta, scale))
    after = search.after(scale, history, theta - params.theta, ~same, fun, small)
    new_y, after = where(finite, (new_y, after), (y, search))
    seen = Seen(params.layout.tree(point), there)
    rest = sigma, batch.count + tried, finite, seen, batch.overflowed
    progress = progress.after(y, fun, stderr, *rest)
    restarts = state.restarts
    if restarts is not None:
        lowest = progress.best_smoothed < state.progress.best_smoothed
        first = BatchSearch.start(jax.tree.map(jnp.zeros_like, history))
        start = params.layout.tree(restarts.theta)
        (new_y, after), restarts = restarts.after(lowest, search.scale).next(
            after.over(solver.patience or _PATIENCE), (new_y, after), (start, first)
        )
    return new_y, BatchState(progress, after, restarts), aux


def judge(
    solver: Any, fn: Any, y: PyTree[Array], args: PyTree, options: dict, state: BatchState
) -> tuple[PyTree[Array], dict[str, Array]]:
    """Judges all that was seen and the last iterate; with noise also the start and the best."""
    progress = state.progress
    count = evaluations_per_step(solver, y)
    # with restarts, on the width on which the lowest estimate was made
    scale = state.search.scale if state.restarts is None else state.restarts.kernel

    def samples(y: PyTree[Array], key: Array) -> Array:
        params = smoothed_params(solver, y, progress.step, options)
        return _points(solver, params, key, params.sigma * scale, count)

    # every iterate but the last was evaluated
    new, old = [y], (progress.start_y, progress.best_y)
    evaluate = _evaluator(solver, fn, args, y)
    return judge_rows(progress, evaluate, options, solver.nonfinite, samples, count, new, old)


def _evaluator(solver: Any, fn: Any, args: PyTree, y: PyTree[Array]) -> Evaluator:
    return Evaluator(fn, args, layout_of(y), True, solver.batch_size, solver.sharding)


def _best(
    params: Params,
    residuals: Evaluator,
    sigma: Array,
    steps: Float[Array, "k n"],
    here: Float[Array, " P"],
) -> tuple[Array, Array, Array, Array]:
    """The step that leads to the smallest sum of squares, if that is a smaller one, and its length.

    Also the end of that step, smaller or not, with half the sum of squares there.
    """
    ends = kept(jax.vmap(params.clip)(params.theta[None] + sigma[None] * steps))
    found = jnp.sum(residuals(ends)[0] ** 2, axis=1)
    found = jnp.where(jnp.isfinite(found), found, jnp.inf)
    best = jnp.argmin(found)
    move = jnp.where(found[best] < jnp.sum(here**2), steps[best], 0)
    return move, jnp.max(jnp.abs(move)), ends[best], found[best] / 2
