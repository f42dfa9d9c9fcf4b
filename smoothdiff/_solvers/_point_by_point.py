"""The loop around searches that evaluate a function point by point: bounds, noise, restarts."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from smoothdiff._draws import Draws
from smoothdiff._params import Params
from smoothdiff._samplers import Sobol
from smoothdiff._seen import Seen, kept, lowest
from smoothdiff._solvers._base import (
    Progress,
    promotion,
    read_options,
    smoothed_params,
    unless_failed,
)
from smoothdiff._solvers._evaluator import Evaluator
from smoothdiff._solvers._history import History
from smoothdiff._solvers._judgement import judged, judging
from smoothdiff._solvers._point_search import AbstractPointSearch, Sizes

# by default a search ends after so many evaluations for each parameter, and one, without a lower
# point
PATIENCE = 20
# of at least so many evaluations half must be finite where others may be dropped
_ENOUGH = 10
# the widths of later searches without bounds, relative to sigma, as powers of two at random
_WIDTHS = 2.0


class PointState(eqx.Module):
    """The state of a run: `restarts` counts the searches that may still follow."""

    progress: Progress
    search: AbstractPointSearch
    restarts: Array


def final_evaluations(candidates: int) -> int:
    """The best point again, and so many candidates of the search; with noise the start as well."""
    return judging(0, new=candidates, old=1)


def init(solver: Any, y: PyTree[Array], search: AbstractPointSearch) -> PointState:
    """The state before a search that has evaluated nothing."""
    restarts = jnp.asarray(solver.restarts, jnp.int32)
    return PointState(Progress.start(y, search.start.dtype), search, restarts)


def step(
    solver: Any,
    sizes: Sizes,
    evaluator: Callable[[Params], Evaluator],
    y: PyTree[Array],
    options: dict,
    state: PointState,
) -> tuple[PyTree[Array], PointState, PyTree]:
    """The next evaluation, or as many as run at once."""
    progress, search = state.progress, state.search
    params = smoothed_params(solver, y, progress.step, options)
    evaluate = evaluator(params)
    key = read_options(options)[0]
    draw = partial(_samples, solver, key, search, params)
    points, proposal = search.propose(params, draw, sizes)
    points = kept(jax.vmap(params.clip)(points))
    rows, aux = evaluate(points)
    funs = evaluate.funs(rows)
    good = jnp.isfinite(funs)
    rows, known = jnp.where(good[:, None], rows, 0), jnp.where(good, funs, 0)
    after = search.after(params, History(points, rows, known, good), proposal, sizes)

    theta, width = after.iterate(), after.width()
    new_y = params.layout.tree(theta)
    with promotion():
        moved = jnp.abs(theta - params.theta) + params.sigma * width
        small = solver.norm(params.layout.tree(moved)) < solver.atol + solver.rtol * solver.norm(y)
    point, fun = lowest(points, jnp.where(good, funs, jnp.inf))
    after = after.counted(small, fun < progress.lowest_fun, sizes.step)
    # the end of a step that is tried may be anything, and so may a place that nobody asked for
    later = state.restarts < solver.restarts
    if solver.nonfinite == "propagate":
        finite = jnp.all(good) | later
    else:
        finite = after.enough(max(sizes.first, _ENOUGH))
    finite = (finite | search.is_local()) & jnp.all(jnp.isfinite(theta))
    new_y, after = unless_failed(finite, (new_y, after), (y, search))
    best = after.history.best(theta)[2]
    unknown = jnp.asarray(jnp.nan, theta.dtype)
    seen = Seen(params.layout.tree(point), fun)
    progress = progress.after(y, best, unknown, params.sigma * width, sizes.step, finite, seen)
    restarts = state.restarts
    if solver.restarts:
        lost = later & ~jnp.any(after.history.valid)
        ended = (restarts > 0) & after.over(sizes)
        again = finite & (ended | lost)
        lowest_theta = params.layout.vector(jax.tree.leaves(progress.lowest_y))
        place, other = jax.random.split(jax.random.fold_in(key, progress.evaluations))
        theta = _anywhere(params, place, lowest_theta)
        start = params.layout.vector(jax.tree.leaves(progress.start_y))
        anew = after.again(params, theta, start, other)
        new_y, after = jax.tree.map(
            lambda a, b: jnp.where(again, a, b), (params.layout.tree(theta), anew), (new_y, after)
        )
        restarts = restarts - (finite & ended).astype(restarts.dtype)
    return new_y, PointState(progress, after, restarts), aux


def judge(evaluate: Evaluator, state: PointState) -> tuple[PyTree[Array], dict[str, Array]]:
    """The best point of those seen and of what the models say.

    The smoothed function is that of the model, at no further evaluation.
    """
    progress = state.progress
    unknown = jnp.asarray(jnp.nan, progress.fun.dtype)

    def estimate(y: PyTree) -> tuple[Array, Array, Seen]:
        smoothed = progress.lowest_fun + state.search.smoothing()
        return smoothed, unknown, Seen(y, jnp.full_like(unknown, jnp.inf))

    params = evaluate.params
    new = [params.layout.tree(params.clip(theta)) for theta in state.search.candidates()]
    return judged(progress, evaluate.values, estimate, 0, new, [progress.start_y])


def _samples(
    solver: Any, key: Array, search: AbstractPointSearch, params: Params, count: int
) -> Array:
    """Standard normal points for a round."""
    key = jax.random.fold_in(key, search.round())
    sampler = solver.sampler or Sobol()
    draws = Draws(sampler, key, count, params.theta.size, params.theta.dtype, None)
    z, log_ratio = draws.map(lambda z, log_ratio: (z, log_ratio))
    if log_ratio is not None or not sampler.gaussian:
        raise ValueError(f"{sampler} has weights: {type(solver).__name__} needs normal points")
    return z


def _anywhere(params: Params, key: Array, lowest: Array) -> Array:
    """A point within the bounds; without them, around the lowest so far at a random width."""
    key, other = jax.random.split(key)
    n, dtype = params.theta.size, params.theta.dtype
    if params.low is not None and params.high is not None:
        share = jax.random.uniform(key, (n,), dtype)
        inside = params.low + share * (params.high - params.low)
    else:
        inside = jnp.full(n, jnp.inf, dtype)
    power = jax.random.uniform(other, (), dtype, -_WIDTHS, _WIDTHS)
    around = lowest + params.sigma * 2.0**power * jax.random.normal(key, (n,), dtype)
    return params.clip(jnp.where(jnp.isfinite(inside), inside, around))
