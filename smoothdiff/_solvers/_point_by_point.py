"""Gauss-Newton with few parameters, on a function that is evaluated point by point."""

import math
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
from smoothdiff._solvers._judgement import judged, judging
from smoothdiff._solvers._residual_batch import Residuals, half_squares, loss_at
from smoothdiff._solvers._residual_history import History
from smoothdiff._solvers._residual_search import ResidualSearch, Sizes

# by default a search ends after so many evaluations for each parameter, and one, without a lower
# point
_PATIENCE = 20
# the widths of later searches without bounds, relative to sigma, as powers of two at random
_WIDTHS = 2.0


class PointState(eqx.Module):
    """The state of a run: `restarts` counts the searches that may still follow."""

    progress: Progress
    search: ResidualSearch
    restarts: Array


def sizes_of(solver: Any, y: PyTree[Array]) -> Sizes:
    """One evaluation a step, or as many as the user says can run at once."""
    n = sum(leaf.size for leaf in jax.tree.leaves(y))
    first = solver.num_samples or 4 + int(3 * math.log(n))
    # what the history has need not be seen again
    later = first if solver.num_samples else min(first, max(2, n))
    return Sizes(solver.num_samples or 1, first, later)


def evaluations_per_step(solver: Any, y: PyTree[Array]) -> int:
    """One, unless more can run at once."""
    return sizes_of(solver, y).step


def final_evaluations(solver: Any, y: PyTree[Array]) -> int:
    """The best point again; with noise the start as well."""
    return judging(0, new=0, old=1)


def init(solver: Any, y: PyTree[Array], options: dict[str, Any], size: int) -> PointState:
    """Nothing is known of so many residuals."""
    params = smoothed_params(solver, y, jnp.asarray(0, jnp.int32), options)
    n, dtype = params.theta.size, params.theta.dtype
    sizes = sizes_of(solver, y)
    usual = max(min(max(12 * n, 32), 256), 3 * sizes.first, 2 * n)
    length = max(solver.history or usual, sizes.first, n + 2)
    search = ResidualSearch.of(params.theta, History.empty(length, n, size, dtype))
    restarts = jnp.asarray(solver.restarts, jnp.int32)
    return PointState(Progress.start(y, dtype), search, restarts)


def step(
    solver: Any, fn: Any, y: PyTree[Array], args: PyTree, options: dict, state: PointState
) -> tuple[PyTree[Array], PointState, PyTree]:
    """The next evaluation, or as many as run at once."""
    progress, search = state.progress, state.search
    params = smoothed_params(solver, y, progress.step, options)
    sizes = sizes_of(solver, y)
    key = read_options(options)[0]
    draw = partial(_samples, solver, key, search, params, sizes)
    points, proposal = search.propose(params, draw, sizes)
    points = kept(jax.vmap(params.clip)(points))
    rows, aux = Residuals(fn, args, params, solver.batch_size)(points)
    good = jnp.isfinite(jnp.sum(rows**2, axis=1))
    rows = jnp.where(good[:, None], rows, 0)
    after = search.after(params, points, rows, good, proposal, sizes)

    theta, width = after.iterate(), after.width()
    new_y = params.layout.tree(theta)
    with promotion():
        moved = jnp.abs(theta - params.theta) + params.sigma * width
        small = solver.norm(params.layout.tree(moved)) < solver.atol + solver.rtol * solver.norm(y)
    point, fun = lowest(points, jnp.where(good, half_squares(rows), jnp.inf))
    after = after.counted(small, fun < progress.lowest_fun, sizes.step)
    # the end of a step that is tried may be anything, and so may a place that nobody asked for
    later = state.restarts < solver.restarts
    if solver.nonfinite == "propagate":
        finite = jnp.all(good) | search.is_local() | later
    else:
        finite = after.enough(sizes.first)
    finite &= jnp.all(jnp.isfinite(theta))
    new_y, after = unless_failed(finite, (new_y, after), (y, search))
    _, best = after.history.best(theta)
    unknown = jnp.asarray(jnp.nan, theta.dtype)
    seen = Seen(params.layout.tree(point), fun)
    progress = progress.after(
        y, jnp.sum(best**2) / 2, unknown, params.sigma * width, sizes.step, finite, seen
    )
    restarts = state.restarts
    if solver.restarts:
        patience = solver.patience or _PATIENCE * (params.theta.size + 1)
        lost = later & ~jnp.any(after.history.valid)
        ended = (restarts > 0) & after.over(patience)
        again = finite & (ended | lost)
        lowest_theta = params.layout.vector(jax.tree.leaves(progress.lowest_y))
        theta = _anywhere(params, jax.random.fold_in(key, progress.evaluations), lowest_theta)
        anew = after.again(theta)
        new_y, after = jax.tree.map(
            lambda a, b: jnp.where(again, a, b), (params.layout.tree(theta), anew), (new_y, after)
        )
        restarts = restarts - (finite & ended).astype(restarts.dtype)
    return new_y, PointState(progress, after, restarts), aux


def judge(
    solver: Any, fn: Any, y: PyTree[Array], args: PyTree, options: dict, state: PointState
) -> tuple[PyTree[Array], dict[str, Array]]:
    """The best point. The smoothed loss is that of the model, at no further evaluation."""
    progress, search = state.progress, state.search
    params = smoothed_params(solver, y, progress.step, options)
    values = loss_at(Residuals(fn, args, params, solver.batch_size))
    unknown = jnp.asarray(jnp.nan, progress.fun.dtype)

    def estimate(y: PyTree) -> tuple[Array, Array, Seen]:
        jacobian = search.trust.jacobian * search.width()
        smoothed = progress.lowest_fun + jnp.sum(jacobian**2) / 2
        return smoothed, unknown, Seen(y, jnp.full_like(unknown, jnp.inf))

    return judged(progress, values, estimate, 0, [], [progress.start_y])


def _samples(
    solver: Any, key: Array, search: ResidualSearch, params: Params, sizes: Sizes
) -> Array:
    """Standard normal points for a round."""
    key = jax.random.fold_in(key, search.wide.rounds)
    sampler, count = solver.sampler or Sobol(), max(sizes.first - 1, 1)
    draws = Draws(sampler, key, count, params.theta.size, params.theta.dtype, None)
    return draws.map(lambda z, _: z)


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
