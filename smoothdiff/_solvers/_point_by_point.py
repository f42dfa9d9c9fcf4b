"""The loop around searches that evaluate a function point by point: bounds, noise, restarts."""

import dataclasses
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from smoothdiff._draws import Draws
from smoothdiff._params import Params
from smoothdiff._samplers import Sobol
from smoothdiff._seen import Seen, kept, lowest
from smoothdiff._solvers._base import (
    Progress,
    read_options,
    smoothed_params,
)
from smoothdiff._solvers._box import anywhere
from smoothdiff._solvers._convergence import signs
from smoothdiff._solvers._evaluator import Evaluator, objectives
from smoothdiff._solvers._history import History
from smoothdiff._solvers._judgement import Contest, Values, evaluated
from smoothdiff._solvers._look import Look
from smoothdiff._solvers._point_search import AbstractPointSearch
from smoothdiff._solvers._random_numbers import in_step, takes_key
from smoothdiff._solvers._stages import Sizes
from smoothdiff._solvers._where import where

# by default a search ends after so many evaluations for each parameter, and one, that hardly
# lowered the function, but after no fewer steps than that
_PATIENCE, _STEPS = 20, 5
# of the last evaluations, at least so many, one must be finite where others may be dropped
_ENOUGH = 10


class PointState(eqx.Module):
    """The state of a run: `restarts` counts the searches that may still follow.

    `aux` is what the function returned beside its value at the iterate, and zeros before it was
    evaluated there. Of the searches that have ended, `found` has the evaluations of the one that
    went lowest: for the errors of parameters, so of residuals, and where searches may follow.
    """

    progress: Progress
    search: AbstractPointSearch
    restarts: Array
    found: History | None
    aux: PyTree[Array]

    def around_lowest(self) -> History:
        """The evaluations of the search that went lowest, of equals the last, as the answer is."""
        here, before = self.search.history, self.found
        return here if before is None else where(before.went_lower(here), before, here)


def patience(n: int, num_samples: int | None) -> int:
    """The default, in evaluations."""
    return max(_PATIENCE * (n + 1), _STEPS * (num_samples or 1))


def init(
    solver: Any,
    y: PyTree[Array],
    search: AbstractPointSearch,
    options: dict[str, Any],
    aux_struct: PyTree,
) -> PointState:
    """The state before a search that has evaluated nothing.

    Raises:
        ValueError: other searches are to follow, of a function that takes random numbers.
    """
    if takes_key(options):
        if solver.restarts:
            raise ValueError(
                f"restarts={solver.restarts} do not go with takes_key=True, as no search of such a "
                "function ends: call minimise from several starts instead"
            )
        search = search.averaging()
    elif not solver.squares or read_options(options)[1] is not None:
        search = dataclasses.replace(search, look=Look.start(search.start))
    if solver.sampler is not None:
        draw = lambda key: _normal_points(solver, key, 1, search.start)
        jax.eval_shape(draw, jax.random.key(0))
    restarts = jnp.asarray(solver.restarts, jnp.int32)
    empty = jax.tree.map(jnp.zeros_like, search.history)
    found = empty if solver.squares and solver.restarts else None
    aux = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), aux_struct)
    return PointState(Progress.start(y, search.start.dtype), search, restarts, found, aux)


class PointStep(eqx.Module):
    """One step in parts, between which the function is evaluated.

    They know shapes only, so that a host loop compiles them once for all functions.
    """

    solver: Any
    sizes: Sizes
    y: PyTree[Array]
    options: dict[str, Any]
    state: PointState

    def params(self) -> Params:
        """The parameters with the solver's sigma."""
        step = jnp.asarray(self.state.progress.step)  # on the host it is NumPy's
        return smoothed_params(self.solver, self.y, step, self.options)

    def numbers(self, args: PyTree) -> PyTree:
        """The arguments of the function in this step."""
        return in_step(args, self.options, self.state.search.numbers())

    def propose(self, stage: int | None = None) -> tuple[Float[Array, "K n"], Any]:
        """The points that come next, within the bounds, and what the model says of them."""
        params, search = self.params(), self.state.search
        draw = partial(_samples, self.solver, read_options(self.options)[0], search)
        points, proposal = search.propose(params, draw, self.sizes, stage)
        return kept(jax.vmap(params.clip)(points)), proposal

    def searched(
        self,
        points: Float[Array, "K n"],
        rows: Float[Array, "K P"],
        proposal: Any,
        stage: int | None = None,
    ) -> AbstractPointSearch:
        """The search with what the function returned at these points."""
        new = self._new(points, rows)
        return self.state.search.after(self.params(), new, proposal, self.sizes, stage)

    def counted(
        self, points: Float[Array, "K n"], rows: Float[Array, "K P"], after: AbstractPointSearch
    ) -> tuple[PyTree[Array], PointState]:
        """The iterate and the state with that search, or with another one if it is over."""
        solver, sizes, state, params = self.solver, self.sizes, self.state, self.params()
        progress, search = state.progress, state.search
        funs = objectives(rows, solver.squares)
        good = jnp.isfinite(funs)
        theta, width = after.iterate(), after.width()
        new_y = params.layout.tree(theta)
        point, fun = lowest(points, jnp.where(good, funs, jnp.inf))
        new = points, rows, fun
        small, last, least = signs(solver, params, search, after, new, progress.lowest_fun)
        # where a model is wrong, its steps may be short for that: a check comes after the first
        looking = search.is_looking()
        checks = small & (search.small == 0) & ~after.right() & ~looking
        after = after.counted(small | looking, search.teaches(), least | last, sizes.step)
        after = where(checks, after.checked(), after).looking(params, sizes, least)
        # the end of a step that is tried may be anything, and so may a place that nobody asked for
        later = state.restarts < solver.restarts
        if solver.nonfinite == "propagate":
            finite = jnp.all(good) | later
        else:
            finite = after.enough(max(sizes.first, _ENOUGH))
        finite = (finite | search.is_trial()) & jnp.all(jnp.isfinite(theta))
        # the history is no worse for a failed evaluation, and long: it is not chosen between
        search = dataclasses.replace(search, history=after.history)
        new_y, after = where(finite, (new_y, after), (self.y, search))
        unknown = jnp.asarray(jnp.nan, theta.dtype)
        seen = Seen(params.layout.tree(point), fun)
        overflowed = jnp.any(jnp.isinf(funs) & jnp.all(jnp.isfinite(rows), axis=1))
        rest = params.sigma * width, sizes.step, finite, seen, overflowed
        progress = progress.after(self.y, unknown, unknown, *rest)
        restarts, found = state.restarts, state.found
        if solver.restarts:
            lost = later & ~jnp.any(after.history.valid)
            ended = (restarts > 0) & after.over(sizes) & after.looked()
            # no other search finds less
            again = finite & (ended | lost) & ~least
            now = new_y, after, found
            new_y, after, found = where(again, self._anew(progress, after), now)
            restarts = restarts - (finite & ended).astype(restarts.dtype)
            restarts = jnp.where(least, 0, restarts)
        return new_y, PointState(progress, after, restarts, found, state.aux)

    def _anew(
        self, progress: Progress, before: AbstractPointSearch
    ) -> tuple[PyTree[Array], AbstractPointSearch, History | None]:
        """The iterate and the state of another search, and the history of the lowest before it."""
        params = self.params()
        lowest_theta = params.layout.vector(jax.tree.leaves(progress.lowest_y))
        key = jax.random.fold_in(read_options(self.options)[0], progress.step)
        place, other = jax.random.split(key)
        theta = anywhere(params, place, lowest_theta)
        start = params.layout.vector(jax.tree.leaves(progress.start_y))
        lowest_fun = progress.lowest_fun.astype(theta.dtype)
        anew = before.again(params, theta, start, (lowest_theta, lowest_fun), other)
        ended = dataclasses.replace(self.state, search=before)
        found = None if self.state.found is None else ended.around_lowest()
        return params.layout.tree(theta), anew, found

    def learnt(self, points: Float[Array, "K n"], rows: Float[Array, "K P"]) -> PointState:
        """The state with evaluations that it did not propose."""
        state, params = self.state, self.params()
        progress, search = state.progress, state.search
        new = self._new(points, rows)
        # nobody asked for them, so they are no sign of a search that leads nowhere
        search = search.kept(new).marked(0)
        point, fun = lowest(points, jnp.where(new.valid, new.funs, jnp.inf))
        seen = Seen(params.layout.tree(point), fun)
        same = progress.smoothed, progress.stderr, progress.sigma
        progress = progress.after(self.y, *same, len(points), progress.finite, seen)
        return dataclasses.replace(state, progress=progress, search=search)

    def over(self) -> Bool[Array, ""]:
        """Whether the solver wants to stop here."""
        return self.solver.terminate(None, self.y, None, self.options, self.state, frozenset())[0]

    def _new(self, points: Float[Array, "K n"], rows: Float[Array, "K P"]) -> History:
        """These evaluations, of which those count that are finite."""
        funs = objectives(rows, self.solver.squares)
        good = jnp.isfinite(funs)
        rows, funs = jnp.where(good[:, None], rows, 0), jnp.where(good, funs, 0)
        return History.of(points, rows, funs, good, self.state.search.numbers())

    def step(self, evaluate: Evaluator) -> tuple[PyTree[Array], PointState, PyTree]:
        """The next evaluation, or as many as run at once."""
        points, proposal = self.propose()
        rows, aux = evaluate.with_aux(points)
        y, state = self.counted(points, rows, self.searched(points, rows, proposal))
        # what a step returns belongs to the iterate before it; the first of all points is the start
        first = self.state.progress.evaluations == 0
        here = jax.tree.map(lambda a, old: jnp.where(first, a[0], old), aux, state.aux)
        same = jnp.all(points == state.search.iterate()[None], axis=1)
        known, at = jnp.any(same), jnp.argmax(same)
        there = jax.tree.map(lambda a, old: jnp.where(known, a[at], old), aux, here)
        return y, dataclasses.replace(state, aux=there), here

    def judge(self, values: Values) -> tuple[PyTree[Array], dict[str, Array]]:
        """The best point of those seen and of what the models say, by its `values`.

        The smoothed function is that of the model, at no further evaluation.
        """
        return evaluated(self.contest(values.takes_key), values, self._estimate)

    def contest(self, takes_key: bool) -> Contest:
        """The candidates for the answer."""
        progress, search = self.state.progress, self.state.search
        # the start's: a search on a plateau may end so far away that sigma is rounding there
        params = smoothed_params(self.solver, progress.start_y, progress.step, self.options)
        lowest_theta = params.layout.vector(jax.tree.leaves(progress.lowest_y))
        others = search.candidates(params.theta, lowest_theta)
        new = [params.layout.tree(params.clip(theta)) for theta in others]
        # with a key, the lowest of all is no higher than the start by the same numbers
        return Contest.of(progress, takes_key, new, [] if takes_key else [progress.start_y])

    def decided(
        self, contest: Contest, done: Array, found: Array
    ) -> tuple[PyTree[Array], dict[str, Array]]:
        """The best candidate by the values of so many rounds, and the statistics of the run."""
        return contest.decided(done, found, self._estimate, 0)

    def _estimate(self, y: PyTree[Array]) -> tuple[Array, Array, Seen]:
        lowest_fun = self.state.progress.lowest_fun
        unknown = jnp.asarray(jnp.nan, lowest_fun.dtype)
        smoothed = lowest_fun + self.state.search.smoothing()
        return smoothed, unknown, Seen(y, jnp.full_like(unknown, jnp.inf))


def _samples(solver: Any, key: Array, search: AbstractPointSearch, count: int) -> Array:
    """Standard normal points for a round."""
    return _normal_points(solver, jax.random.fold_in(key, search.seed()), count, search.start)


def _normal_points(solver: Any, key: Array, count: int, like: Float[Array, " n"]) -> Array:
    """So many, by the solver's sampler, unless that has others."""
    sampler = solver.sampler or Sobol()
    draws = Draws(sampler, key, count, like.size, like.dtype, None)
    z, log_ratio = draws.map(lambda z, log_ratio: (z, log_ratio))
    if log_ratio is not None or not sampler.gaussian:
        raise ValueError(f"{sampler} has weights: {type(solver).__name__} needs normal points")
    return z
