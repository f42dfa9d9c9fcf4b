"""How methods that are solvers of smoothdiff run: by `sd.minimise` or its twin."""

from collections.abc import Callable
from typing import Any

from benchmarks._task import Solve, Task, Y


def run_by(minimise: Callable, task: Task, fun: Callable[[Y], Any], solver: Any) -> Solve:
    """The solver on a function of y, compiled once for all starts."""

    def with_args(y, args):
        return fun(y)

    def solve(y0, key, record):
        result = minimise(
            with_args,
            y0,
            key=key,
            solver=solver,
            max_evaluations=task.budget.evaluations,
            bounds=task.bounds,
            callback=lambda step: record(step.y),
        )
        if result.reason == "interrupted":
            raise KeyboardInterrupt
        record(result.y)

    return solve
