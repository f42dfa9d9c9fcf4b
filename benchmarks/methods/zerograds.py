"""Ours: ZeroGrads with its defaults, but for a rate that falls over the budget, as others' do."""

import optax

import smoothdiff as sd
from benchmarks._task import MethodEntry, Problem, Solve
from benchmarks.methods._host_loop import run_by

NUM_SAMPLES = 2
RATE, RATE_END = 0.05, 0.001  # in units of sigma, linear in between


def rate(problem: Problem, num_samples: int = NUM_SAMPLES) -> optax.Schedule:
    """The rate of the parameters, in their units."""
    steps = problem.budget.evaluations // num_samples
    return optax.linear_schedule(RATE * problem.sigma, RATE_END * problem.sigma, steps)


def prepare(problem: Problem) -> Solve:
    """One solver and one function for all starts, so that they are compiled once."""
    optim = optax.adam(rate(problem))
    solver = sd.ZeroGrads(problem.sigma, num_samples=NUM_SAMPLES, optimizer=optim)
    return run_by(sd.minimise, problem, problem.loss, solver)


METHODS = {"zerograds": MethodEntry("ZeroGrads (ours)", ("scene", "large", "program"), prepare)}
