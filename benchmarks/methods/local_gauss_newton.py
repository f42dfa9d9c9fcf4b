"""Gauss-Newton in all places at once, where the task says which residuals a parameter moves."""

import smoothdiff as sd
from benchmarks._task import NotAble, Solve, Task
from benchmarks.methods._host_loop import run_by

TITLE = "Gauss-Newton, local support (ours)"


def prepare(task: Task) -> Solve:
    """One solver and one function for all starts, so that they are compiled once."""
    if task.residuals is None or task.support is None:
        raise NotAble("needs residuals with a local support")
    solver = sd.LocalGaussNewton(task.sigma, task.support)
    return run_by(sd.least_squares, task, task.residuals, solver)
