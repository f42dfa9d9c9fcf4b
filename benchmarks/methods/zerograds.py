"""Ours: ZeroGrads with its defaults; sigma and the bounds come from the task."""

import smoothdiff as sd
from benchmarks._task import Solve, Task
from benchmarks.methods._host_loop import run_by

TITLE = "ZeroGrads (ours)"


def prepare(task: Task) -> Solve:
    """One solver and one function for all starts, so that they are compiled once."""
    return run_by(sd.minimise, task, task.loss, sd.ZeroGrads(task.sigma))
