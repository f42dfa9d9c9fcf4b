"""A problem whose solver steps point by point: its function is called between compiled parts."""

import contextlib
import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, PyTree

from smoothdiff._call_checks import check_squares
from smoothdiff._devices import brought, is_moved, on_cpu, where_committed
from smoothdiff._host_function import evaluator, rows_at, traced
from smoothdiff._host_steps import HostSteps
from smoothdiff._known import Known
from smoothdiff._problem import Problem, Trial
from smoothdiff._programs import is_short
from smoothdiff._solvers._evaluator import Evaluator
from smoothdiff._solvers._judgement import Values, differ
from smoothdiff._solvers._point_by_point import PointState, PointStep
from smoothdiff._solvers._random_numbers import in_round, takes_key


class HostProblem(Problem):
    """A problem whose solver steps point by point.

    Its steps may be `moved` to a CPU from the device of the function.
    """

    host: HostSteps
    known: Known | None
    device: Any = eqx.field(static=True)
    moved: bool = eqx.field(static=True)
    quick: bool = eqx.field(static=True, default=False)

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
        return HostProblem(fun, solver, args, options, host, known, device, moved)

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

    def stage(self, state: PointState) -> int:
        """That of the search."""
        return int(state.search.stage)

    def step(self, y: PyTree, state: PointState) -> tuple[PyTree, PointState, Bool[Array, ""]]:
        """The next evaluations, between what is compiled for the stage of the search."""
        points, proposal = self.host.propose(y, state)
        args = self.args
        if takes_key(self.options):
            args = self.host.parts(y, state).numbers(args)
        before = self._answered()
        rows = self._rows(_evaluator(self, args, y), points, len(points))
        if self.solver.squares and state.progress.step == 0:
            check_squares(np.asarray(rows[0]))
        y, state, over = self.host.told(y, state, points, rows, proposal)
        if (answered := self._answered() - before) > 0:
            count = state.progress.evaluations - answered
            state = eqx.tree_at(lambda s: s.progress.evaluations, state, count)
        return y, state, over | self._exhausted()

    def done(self, y: PyTree, state: PointState) -> Bool[Array, ""]:
        """Whether the solver wants to stop before a step, compiled for shapes."""
        return _done(self.host.parts(y, state)) | self._exhausted()

    def reason(self, state: PointState) -> str:
        """As the solver, unless all points are known."""
        return "converged" if self.known and self.known.complete else super().reason(state)

    def resumed(self, state: PointState) -> None:
        """Knows what the search has evaluated."""
        if self.known is not None:
            history = state.search.history
            self.known.learn(history.points[history.valid], history.rows[history.valid])

    def spare(self, y: PyTree, state: PointState) -> int:
        """Of the evaluations for the judgement, those that a function without noise leaves."""
        if takes_key(self.options):
            return 0
        start = state.search.start
        others = len(state.search.candidates(start, start))
        return self.solver.final_evaluations(y) - 2 - others

    def trial(self, y: PyTree, state: PointState) -> Trial:
        """The lowest point once more."""
        point, fun = state.progress.lowest_y, state.progress.lowest_fun
        points = jax.tree.map(lambda a: a[None], point)
        again = self._values(y).at(points, jnp.asarray(0, jnp.int32))
        return Trial(again, bool(~jnp.isfinite(fun) | differ(again[0], fun)))

    def judge(
        self, y: PyTree, state: PointState, trial: Trial | None = None
    ) -> tuple[PyTree, dict[str, Any]]:
        """Decided on the host, so that nothing is compiled for it."""
        values, parts = self._values(y), self.host.parts(y, state)
        if trial is None:
            return parts.judge(values, _loop)
        if trial.noisy:
            return parts.judge(values._replace(at=partial(_known_last, values.at, trial)), _loop)
        y, stats = parts.judge(values, _once)
        return y, stats | {"evaluations": stats["evaluations"] + 1}

    def _values(self, y: PyTree) -> Values:
        """The function itself, also where it is known: that may have been luck."""

        def at(points: PyTree[Array], number: Array) -> Array:
            args = in_round(self.args, self.options, number)
            evaluate = _evaluator(self, args, y)
            vectors = jax.vmap(lambda y: evaluate.layout.vector(jax.tree.leaves(y)))(points)
            return evaluate.funs(self._rows(evaluate, vectors, self.host.sizes.step, judging=True))

        return Values(at, takes_key(self.options))

    def _rows(
        self, evaluate: Evaluator, points: Array, at_once: int, judging: bool = False
    ) -> Array:
        """What the function returns at points, so many at once, unless it is known."""

        def fresh(points: Array) -> Array:
            if not self.moved:
                return rows_at(evaluate, points, at_once, self.quick)
            with jax.default_device(self.device):
                rows = rows_at(evaluate, points, at_once, self.quick)
            return brought(rows)

        if self.known is None:
            return fresh(points)
        rows = self.known.fresh if judging else self.known.rows
        return rows(points, fresh)

    def _answered(self) -> int:
        return 0 if self.known is None else self.known.answered

    def _exhausted(self) -> bool:
        return self.known is not None and self.known.exhausted


def _evaluator(problem: HostProblem, args: PyTree, y: PyTree) -> Evaluator:
    solver = problem.solver
    parts = (getattr(solver, name, None) for name in ("batch_size", "sharding"))
    return evaluator(problem.fun, solver.squares, args, y, *parts)


@eqx.filter_jit
def _done(step: PointStep) -> Bool[Array, ""]:
    return step.over()


def _loop(more: Callable, body: Callable, state: Any) -> Any:
    """`jax.lax.while_loop` on the host."""
    while more(state):
        state = body(state)
    return state


def _once(more: Callable, body: Callable, state: Any) -> Any:
    """The same where one round is enough."""
    return body(state)


def _known_last(at: Callable, trial: Trial, points: PyTree[Array], number: Array) -> Array:
    """The values `at` these points; in the first round that of the last one is known."""
    if number > 0:
        return at(points, number)
    rest = jax.tree.map(lambda a: a[:-1], points)
    more = len(jax.tree.leaves(rest)[0]) > 0
    return jnp.concatenate([*([at(rest, number)] if more else []), trial.fun])
