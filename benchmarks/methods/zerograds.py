"""Ours: ZeroGrads with its defaults, on schedules over the budget, as others have them.

With few parameters sigma and the rate fall as for all first-order methods here. With many, a sigma
that falls harms: `python -m benchmarks zerograds ablations` compares both.
"""

from typing import Any

import optax

import smoothdiff as sd
from benchmarks._task import MethodEntry, Problem, Solve
from benchmarks.methods._flat import Flat
from benchmarks.methods._host_loop import run_by

NUM_SAMPLES = 2
FEW = 50  # parameters; from there on the defaults of the solver are others, too
# in units of sigma, linear in between: the rate at the start and at the end, and sigma at the end
OF_FEW, OF_MANY = (0.15, 0.003, 0.1), (0.05, 0.001, 1.0)


def solver(problem: Problem, num_samples: int = NUM_SAMPLES, **changes: Any) -> sd.ZeroGrads:
    """The solver for a problem, but for `changes`."""
    steps, sigma = problem.budget.evaluations // num_samples, problem.sigma
    rate, rate_end, sigma_end = OF_FEW if Flat(problem).size <= FEW else OF_MANY
    falling = lambda first, last: optax.linear_schedule(first * sigma, last * sigma, steps)
    optim = optax.adam(falling(rate, rate_end))
    width = sigma if sigma_end == 1 else falling(1.0, sigma_end)
    return sd.ZeroGrads(width, num_samples=num_samples, optimizer=optim, **changes)


def prepare(problem: Problem) -> Solve:
    """One solver and one function for all starts, so that they are compiled once."""
    return run_by(sd.minimise, problem, problem.loss, solver(problem))


METHODS = {"zerograds": MethodEntry("ZeroGrads (ours)", ("scene", "large", "program"), prepare)}
