"""Ours: ZeroGrads with its defaults, but for a rate that falls over the budget, as others' do."""

import optax

import smoothdiff as sd
from benchmarks._task import Solve, Task
from benchmarks.methods._host_loop import run_by

TITLE = "ZeroGrads (ours)"
NUM_SAMPLES = 2
RATE, RATE_END = 0.05, 0.001  # in units of sigma, linear in between


def rate(task: Task, num_samples: int = NUM_SAMPLES) -> optax.Schedule:
    """The rate of the parameters, in their units."""
    steps = task.budget.evaluations // num_samples
    return optax.linear_schedule(RATE * task.sigma, RATE_END * task.sigma, steps)


def prepare(task: Task) -> Solve:
    """One solver and one function for all starts, so that they are compiled once."""
    optim = optax.adam(rate(task))
    solver = sd.ZeroGrads(task.sigma, num_samples=NUM_SAMPLES, optimizer=optim)
    return run_by(sd.minimise, task, task.loss, solver)
