"""Smoothed gradient with Adam, after Fischer and Ritschel 2022.

Gaussian samples in antithetic pairs; sigma is annealed linearly over the budget, as in the papers.
"""

import optax

import smoothdiff as sd
from benchmarks._task import MethodEntry, Problem, Solve
from benchmarks.methods._adam import optimiser
from benchmarks.methods._host_loop import run_by

NUM_SAMPLES = 2
SIGMA_END = 0.1  # of the problem's sigma


def prepare(problem: Problem) -> Solve:
    """One solver and one function for all starts, so that they are compiled once."""
    steps = problem.budget.evaluations // NUM_SAMPLES
    solver = sd.FirstOrder(
        optimiser(problem, NUM_SAMPLES),
        optax.linear_schedule(problem.sigma, SIGMA_END * problem.sigma, steps),
        num_samples=NUM_SAMPLES,
        sampler=sd.Gaussian(antithetic=True),
        baseline="none",
    )
    return run_by(sd.minimise, problem, problem.loss, solver)


METHODS = {
    "fr22": MethodEntry(
        "Smoothed gradient, Adam (FR22)", ("scene", "large", "program", "function"), prepare
    )
}
