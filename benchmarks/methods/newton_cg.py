"""Ours: Newton-CG with its defaults; sigma and the bounds come from the task.

Where a search leads nowhere another begins, as with CMA-ES, until the evaluations are spent. A
restart is shown once it has seen something better than all before it.
"""

import smoothdiff as sd
from benchmarks._task import Solve, Task
from benchmarks.methods._host_loop import run_by

TITLE = "Newton-CG (ours)"


def prepare(task: Task) -> Solve:
    """One solver and one function for all starts, so that they are compiled once."""
    return run_by(sd.minimise, task, task.loss, sd.NewtonCG(task.sigma, restarts=2**31 - 1))
