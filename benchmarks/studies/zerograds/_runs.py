"""What all parts share: tasks and their budgets, ours with changes, runs, and panels of errors."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np

import smoothdiff as sd
from benchmarks import _registry, _style
from benchmarks._loop import Run, flat, run
from benchmarks._summary import POINTS, band
from benchmarks._task import Budget, Method, Problem, Task, Y
from benchmarks.methods import zerograds
from benchmarks.methods._host_loop import run_by

FLOOR = 1e-4  # of the error of the start: smaller ones count as that
PLENTY = 3600.0  # seconds: what ends a run is its evaluations
BUDGETS = {
    "brdf": 1000,
    "led": 4000,
    "wicker": 600,
    "node-graph": 2000,
    "rocket10": 2000,
    "gravity": 600,
}
# a change of these makes earlier runs stale
LIBRARY = Path(sd.__file__).parent
FILES = (Path(__file__), LIBRARY / "surrogates.py", *sorted(LIBRARY.glob("_solvers/*.py")))
SOURCE = "".join(path.read_text() for path in FILES)


def load(name: str) -> Task:
    """A task of BUDGETS; of a family the first."""
    task = _registry.family(name, False)[0]
    problem = dataclasses.replace(task.problem, budget=Budget(BUDGETS[name], PLENTY))
    return dataclasses.replace(task, problem=problem)


def configuration(name: str, **changes: Any) -> Method:
    """Ours, but for `changes`, as a method."""
    prepare = lambda problem: run_by(
        sd.minimise, problem, problem.loss, zerograds.solver(problem, **changes)
    )
    source = _registry.method("zerograds").source + SOURCE + repr(sorted(changes.items()))
    return Method(name, name, prepare, source)


class Steps:
    """The steps of a solver on a problem, for who looks at its state, which `minimise` hides."""

    def __init__(self, solver: Any, problem: Problem):
        self.number = problem.budget.evaluations // solver.evaluations_per_step(problem.like)
        fun = lambda y, args: (problem.loss(y), None)
        options = lambda key: {"key": key, "bounds": problem.bounds}

        @jax.jit
        def init(y, key):
            value = jax.eval_shape(problem.loss, y)
            return solver.init(fun, y, None, options(key), value, None, frozenset())

        @jax.jit
        def step(y, state, key):
            return solver.step(fun, y, None, options(key), state, frozenset())[:2]

        self._init, self._step = init, step

    def __call__(self, y: Y, key: jax.Array) -> Iterator[tuple[Y, Any]]:
        """The parameters and the state, at the start and after each step."""
        state = self._init(y, key)
        yield y, state
        for _ in range(self.number):
            y, state = self._step(y, state, key)
            yield y, state

    def at(self, shares: Sequence[float], y: Y, key: jax.Array) -> Iterator[tuple[int, Y, Any]]:
        """Likewise after so much of a run each, and the number of steps until then."""
        ends = {round(share * self.number) for share in shares}
        each = enumerate(self(y, key))
        return ((done, *found) for done, found in each if done in ends)


def ran(task: Task, methods: Sequence[Method], seeds: int, folder: Path, fresh: bool) -> Any:
    """The runs of each method, by its name."""
    found = run(task, methods, range(seeds), folder / task.name, fresh=fresh)
    return {method.name: runs for method, runs in found.items()}


def about(task: Task) -> dict[str, Any]:
    """How many parameters a task has, and the evaluations at which curves are read."""
    costs = np.geomspace(1, task.problem.budget.evaluations, POINTS).round().astype(int)
    return {"parameters": flat(task.problem.like).size, "evaluations": np.unique(costs).tolist()}


def errors(runs: list[Run], evaluations: Sequence[int]) -> list[list[float]]:
    """Quartiles of the image error over the runs, after so many evaluations."""
    return band(runs, "image_error", "evaluations", evaluations)


@contextmanager
def panels(
    path: Path, shown: Mapping[str, Any], x: str, y: str, abreast: int = 4
) -> Iterator[list[tuple[Any, Any]]]:
    """An axis for each title and what it shows; below them is said what is in each."""
    with _style.panels(path, shown, abreast, (3.3, 2.8)) as (drawn, axes):
        for axis in axes[:, 0]:
            axis.set_ylabel(y)
        for axis in axes[-1]:
            axis.set_xlabel(x)
        yield list(zip(axes.flat, shown.values(), strict=False))
        _style.legend(drawn, *axes[0, 0].get_legend_handles_labels())


def curves(
    axis: Any, x: Sequence[float], found: Mapping[str, Any], floor: float = -np.inf, **line: Any
) -> None:
    """By label, lower quartile, median and upper quartile at each x."""
    for colour, (label, quartiles) in zip(_style.COLOURS, found.items(), strict=False):
        _style.band(axis, x, np.maximum(quartiles, floor), {"color": colour, **line}, label)


def sized(tasks: dict[str, Any]) -> dict[str, Any]:
    """The tasks under titles that say how many parameters they have."""
    return {f"{name}, {task['parameters']:,} parameters": task for name, task in tasks.items()}
