"""What is run: a task with the budget that it has here, and the error of its runs."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import _registry
from benchmarks._loop import Run, flat, run
from benchmarks._summary import POINTS, band
from benchmarks._task import Budget, Method, Task

PLENTY = 3600.0  # seconds: what ends a run is its evaluations
BUDGETS = {
    "brdf": 1000,
    "led": 4000,
    "wicker": 600,
    "node-graph": 2000,
    "rocket10": 2000,
    "gravity": 600,
}


def load(name: str) -> Task:
    """A task of BUDGETS; of a family the first."""
    built = _registry.task(name).build(False)
    task = built[0] if isinstance(built, list) else built
    problem = dataclasses.replace(task.problem, budget=Budget(BUDGETS[name], PLENTY))
    return dataclasses.replace(task, problem=problem)


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
    return band(runs, "image_error", "evaluations", np.array(evaluations)).tolist()


def quartiles(values: Any) -> list[Any]:
    """Lower quartile, median and upper quartile over the first axis."""
    return np.quantile(values, [0.25, 0.5, 0.75], axis=0).tolist()
