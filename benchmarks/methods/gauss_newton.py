"""Gauss-Newton on the residuals: each evaluation teaches all pixels.

Samples reach as far as the root of the number of parameters times sigma. With fewer than eight the
first sigma is wider, up to twice, so that samples reach about as far there as with eight.
"""

import math

import jax
import numpy as np

import smoothdiff as sd
from benchmarks._task import NotAble, Solve, Task
from benchmarks.methods._host_loop import run_by

TITLE = "Gauss-Newton on residuals (ours)"
WIDEST, REACH = 2.0, 8  # times the task's sigma, and the number of parameters


def prepare(task: Task) -> Solve:
    """One solver and one function for all starts, so that they are compiled once."""
    if task.residuals is None:
        raise NotAble("this task has no residuals")
    n = sum(np.size(leaf) for leaf in jax.tree.leaves(task.reference))
    wide = min(max(math.sqrt(REACH / n), 1), WIDEST)
    return run_by(sd.least_squares, task, task.residuals, sd.GaussNewton(wide * task.sigma))
