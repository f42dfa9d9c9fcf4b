"""A problem whose solver steps point by point: its function is called between compiled parts."""

import contextlib
import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from smoothdiff._call_checks import check_squares
from smoothdiff._devices import brought, is_moved, on_cpu, put_with, where_committed
from smoothdiff._flat import Flat
from smoothdiff._host_function import evaluator, rows_at, traced
from smoothdiff._host_steps import HostSteps
from smoothdiff._known import Known
from smoothdiff._layout import Layout, layout_of, vectors
from smoothdiff._problem import Problem, Trial
from smoothdiff._programs import is_short, jit_quickly
from smoothdiff._solvers import Progress
from smoothdiff._solvers._evaluator import Evaluator, objectives, row_of
from smoothdiff._solvers._judgement import differ
from smoothdiff._solvers._point_by_point import PointState
from smoothdiff._solvers._random_numbers import in_round, takes_key


@dataclasses.dataclass(frozen=True, eq=False)
class HostProblem(Problem):
    """A problem whose solver steps point by point.

    Its steps may be `moved` to a CPU from the device of the function. The `first` point and its row
    are known where an evaluation had to tell what a black box returns.
    """

    host: HostSteps
    layout: Layout
    known: Known | None
    device: Any
    moved: bool
    quick: bool = False
    first: tuple[np.ndarray, Array] | None = None

    @staticmethod
    def of(
        fun: Callable,
        solver: Any,
        args: PyTree,
        options: dict[str, Any],
        y: PyTree,
        known: Known | None,
    ) -> "HostProblem":
        """For parameters like `y`, once the values of the solver were looked at."""
        device = where_committed(y)
        moved = is_moved(device) and getattr(solver, "sharding", None) is None
        with on_cpu() if moved else contextlib.nullcontext():
            ours = brought((solver, options, y)) if moved else (solver, options, y)
            host = HostSteps.of(*ours)
        return HostProblem(fun, solver, args, options, host, layout_of(y), known, device, moved)

    def place(self) -> contextlib.AbstractContextManager:
        """A CPU, if the steps are moved."""
        return on_cpu() if self.moved else contextlib.nullcontext()

    def here(self, y: PyTree[Array]) -> PyTree[Array]:
        """As new arrays, if the steps are moved."""
        with self.place():
            return brought(y) if self.moved else y

    def begin(self, y: PyTree, check: Callable[[PyTree], None]) -> tuple["HostProblem", PointState]:
        """As for any problem, compiled for shapes; and with how well to compile the function."""
        program, out = traced(self.fun, y, self.args)
        check(out)
        quick = is_short(program, self.host.sizes.step, self.device)
        with self.place():
            return dataclasses.replace(self, quick=quick), self.host.init(self.here(y), out)

    def knowing(self, out: PyTree, y: PyTree, state: PointState) -> tuple[Problem, PointState]:
        """A first step of this point alone, and of these random numbers, needs no other one."""
        shared = getattr(self.solver, "sharding", None) is not None
        if takes_key(self.options) or shared or self.host.sizes.step > 1:
            return super().knowing(out, y, state)
        point = self.layout.vector(jax.tree.leaves(y))[None]
        row = row_of(out, point.dtype)[None]
        # where rows are in later steps, so that these go to the same program
        row = self.here(row) if self.moved else jnp.asarray(put_with(y, np.asarray(row)))
        return dataclasses.replace(self, first=(np.asarray(point), row)), state

    def uncounted(self, progress: Progress) -> int:
        """The first one, until a step has it."""
        return int(self.first is not None and int(progress.step) == 0)

    def stage(self, state: PointState) -> int:
        """That of the search."""
        return int(state.search.stage)

    def step(self, y: PyTree, state: PointState) -> tuple[PyTree, PointState, Bool[Array, ""]]:
        """The next evaluations, between what is compiled for the stage of the search."""
        points, proposal = self.host.propose(y, state)
        evaluate = self._evaluate
        if takes_key(self.options):
            numbers = self.host.parts(y, state).numbers(self.args)
            evaluate = Flat.of(dataclasses.replace(self._evaluator, args=numbers))
        before = 0 if self.known is None else self.known.answered
        rows = self._first_row(points, state)
        if rows is None:
            rows = self._rows(evaluate, points, len(points))
        if self.solver.squares and int(state.progress.step) == 0:
            check_squares(np.asarray(rows)[0])
        y, state, over = self.host.told(y, state, points, rows, proposal)
        if self.known is None:
            return y, state, over
        if (answered := self.known.answered - before) > 0:
            count = state.progress.evaluations - answered
            state = eqx.tree_at(lambda s: s.progress.evaluations, state, count)
        return y, state, over | self.known.exhausted

    def done(self, y: PyTree, state: PointState) -> Bool[Array, ""]:
        """Whether the solver wants to stop before a step, compiled for shapes."""
        over = self.host.over(y, state)
        return over if self.known is None else over | self.known.exhausted

    def reason(self, state: PointState) -> str:
        """As the solver, unless all points are known."""
        return "converged" if self.known and self.known.complete else super().reason(state)

    def resumed(self, state: PointState) -> None:
        """Knows what the search has evaluated."""
        if self.known is not None:
            history = state.search.history
            evaluated = history.evaluated()
            self.known.learn(history.points[evaluated], history.rows[evaluated])

    def spare(self, y: PyTree, state: PointState) -> int:
        """Of the evaluations for the judgement, those that a function without noise leaves."""
        if takes_key(self.options):
            return 0
        return self.solver.final_evaluations(y) - 1 - self.host.contest(y, state).each

    def trial(self, y: PyTree, state: PointState) -> Trial:
        """The lowest point once more."""
        contest = self.host.contest(y, state)
        lowest, before = contest.each - 1, contest.progress.lowest_fun
        again = self._funs(y, vectors(contest.points)[lowest : lowest + 1], 0)
        with _extremes():
            return Trial(again, bool(~np.isfinite(before) | differ(again[0], before)))

    def judge(
        self, y: PyTree, state: PointState, trial: Trial | None = None
    ) -> tuple[PyTree, dict[str, Any]]:
        """With a loop on the host, where the function is called by the program that it has."""
        contest = self.host.contest(y, state, takes_key(self.options))
        points, each, found, done = vectors(contest.points), contest.each, contest.unknown(), 0
        constant = trial is not None and not trial.noisy
        # in the first round the lowest point comes last, whose value a trial may have told
        told = np.empty(0, found.dtype) if trial is None or constant else trial.fun
        with _extremes():
            while contest.goes_on(done, found):
                at = contest.round(done)[: each - len(told)]
                fresh = self._funs(y, points[at], done)
                found[each * done : each * (done + 1)] = np.append(fresh, told)
                told, done = told[:0], done + 1
                if constant:
                    break
        y, stats = self.host.decided(y, state, contest, done, found)
        more = constant + self.uncounted(state.progress)
        return y, stats | {"evaluations": np.asarray(stats["evaluations"]) + more}

    def _funs(
        self, y: PyTree, points: Float[np.ndarray, "m n"], number: int
    ) -> Float[np.ndarray, " m"]:
        """The function itself, also where it is known: that may have been luck."""
        if len(points) == 0:
            return np.empty(0, points.dtype)
        args = in_round(self.args, self.options, number)
        evaluate = Flat.of(dataclasses.replace(self._evaluator, args=args))
        # points that are committed as in steps, so that they go to the same program
        rows = self._rows(evaluate, put_with(y, points), self.host.sizes.step, judging=True)
        return np.asarray(_objectives(rows, self.solver.squares))

    def _first_row(self, points: Array, state: PointState) -> Array | None:
        """What is known of the first point."""
        if self.first is None or int(state.progress.step) > 0:
            return None
        point, row = self.first
        if not np.array_equal(point, np.asarray(points)):
            return None
        if self.known is not None:
            self.known.learn(points, row)
        return row

    @functools.cached_property
    def _evaluator(self) -> Evaluator:
        parts = (getattr(self.solver, name, None) for name in ("batch_size", "sharding"))
        return evaluator(self.fun, self.solver.squares, self.args, self.layout, *parts)

    @functools.cached_property
    def _evaluate(self) -> Flat:
        return Flat.of(self._evaluator)

    def _rows(
        self, evaluate: Flat, points: Array | np.ndarray, at_once: int, judging: bool = False
    ) -> Array:
        """What the function returns at points, so many at once, unless it is known."""

        def fresh(points: Array | np.ndarray) -> Array:
            if not self.moved:
                return rows_at(evaluate, points, at_once, self.quick)
            with jax.default_device(self.device):
                rows = rows_at(evaluate, points, at_once, self.quick)
            return brought(rows)

        if self.known is None:
            return fresh(points)
        rows = self.known.fresh if judging else self.known.rows
        return rows(points, fresh)


# what NumPy would warn of: values that are infinite, or whose difference is
_extremes = functools.partial(np.errstate, invalid="ignore", over="ignore")
_objectives = jit_quickly(objectives, static_argnums=1)
