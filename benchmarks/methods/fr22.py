"""Smoothed gradient with Adam, after Fischer and Ritschel 2022.

Gaussian samples in antithetic pairs; sigma is annealed linearly over the budget, as in the papers.
"""

import optax

import smoothdiff as sd
from benchmarks._task import Solve, Task
from benchmarks.methods._adam import optimiser
from benchmarks.methods._host_loop import run_by

TITLE = "Smoothed gradient, Adam (FR22)"
NUM_SAMPLES = 2
SIGMA_END = 0.1  # of the task's sigma


def prepare(task: Task) -> Solve:
    """One solver and one function for all starts, so that they are compiled once."""
    steps = task.budget.evaluations // NUM_SAMPLES
    solver = sd.FirstOrder(
        optimiser(task, NUM_SAMPLES),
        optax.linear_schedule(task.sigma, SIGMA_END * task.sigma, steps),
        num_samples=NUM_SAMPLES,
        sampler=sd.Gaussian(antithetic=True),
        baseline="none",
    )
    return run_by(sd.minimise, task, task.loss, solver)
