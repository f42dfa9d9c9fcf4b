"""Gauss-Newton on the residuals: each evaluation teaches all pixels."""

import smoothdiff as sd
from benchmarks._task import NotAble, Solve, Task
from benchmarks.methods._host_loop import run_by

TITLE = "Gauss-Newton on residuals (ours)"


def prepare(task: Task) -> Solve:
    """One solver and one function for all starts, so that they are compiled once."""
    if task.residuals is None:
        raise NotAble("this task has no residuals")
    return run_by(sd.least_squares, task, task.residuals, sd.GaussNewton(task.sigma))
