"""Ours: `FirstOrder` with its own sampler and baseline, and Adam.

Sigma and the rate fall together, geometrically, over the budget.
"""

import optax

import smoothdiff as sd
from benchmarks._task import Solve, Task
from benchmarks.methods._host_loop import run_by

TITLE = "First order (ours)"
NUM_SAMPLES = 8
SIGMA_END = 0.05  # of the task's sigma
RATE = 0.3  # in units of sigma
BETAS = 0.9, 0.99  # what is remembered must be from about the same sigma


def prepare(task: Task) -> Solve:
    """One solver and one function for all starts, so that they are compiled once."""
    steps = task.budget.evaluations // NUM_SAMPLES
    end = SIGMA_END * task.sigma
    sigma = optax.exponential_decay(task.sigma, steps, SIGMA_END, end_value=end)
    optim = optax.adam(lambda step: RATE * sigma(step), *BETAS)
    solver = sd.FirstOrder(optim, sigma, num_samples=NUM_SAMPLES)
    return run_by(sd.minimise, task, task.loss, solver)
