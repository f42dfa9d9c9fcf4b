"""Ours, each with its defaults as far as may be; sigma and the bounds come from the problem.

In each there is one solver and one function for all starts, so that they are compiled once.
"""

import math

import optax

import smoothdiff as sd
from benchmarks._task import MethodEntry, NotAble, Problem, Solve
from benchmarks.methods._flat import Flat
from benchmarks.methods._host_loop import run_by

NUM_SAMPLES = 8  # of first_order
SIGMA_END = 0.05  # of the problem's sigma
RATE = 0.3  # in units of sigma
BETAS = 0.9, 0.99  # what is remembered must be from about the same sigma
MOST = 3000  # parameters of newton_cg
WIDEST, REACH = 2.0, 8  # of gauss_newton: times the problem's sigma, and the number of parameters


def first_order(problem: Problem) -> Solve:
    """Its own sampler and baseline, and Adam. Sigma and the rate fall together, geometrically."""
    steps = problem.budget.evaluations // NUM_SAMPLES
    end = SIGMA_END * problem.sigma
    sigma = optax.exponential_decay(problem.sigma, steps, SIGMA_END, end_value=end)
    optim = optax.adam(lambda step: RATE * sigma(step), *BETAS)
    solver = sd.FirstOrder(optim, sigma, num_samples=NUM_SAMPLES)
    return run_by(sd.minimise, problem, problem.loss, solver)


def newton_cg(problem: Problem) -> Solve:
    """Where a search leads nowhere another begins, as with CMA-ES, until the budget is spent."""
    if Flat(problem).size > MOST:
        raise NotAble(f"is for up to {MOST} parameters; for more there is first_order")
    solver = sd.NewtonCG(problem.sigma, restarts=2**31 - 1)
    return run_by(sd.minimise, problem, problem.loss, solver)


def gauss_newton(problem: Problem) -> Solve:
    """On the residuals: each evaluation teaches all pixels.

    Samples reach as far as the root of the number of parameters times sigma. With fewer than eight
    the first sigma is wider, up to twice, so that samples reach about as far there as with eight.
    """
    if problem.residuals is None:
        raise NotAble("this task has no residuals")
    wide = min(max(math.sqrt(REACH / Flat(problem).size), 1), WIDEST)
    solver = sd.GaussNewton(wide * problem.sigma)
    return run_by(sd.least_squares, problem, problem.residuals, solver)


def local_gauss_newton(problem: Problem) -> Solve:
    """In all places at once, where the problem says which residuals a parameter moves."""
    if problem.residuals is None or problem.support is None:
        raise NotAble("needs residuals with a local support")
    solver = sd.LocalGaussNewton(problem.sigma, problem.support)
    return run_by(sd.least_squares, problem, problem.residuals, solver)


def shortest(problem: Problem) -> Solve:
    """What is called without a solver and without sigma: all it is told are the bounds."""
    if problem.residuals is None:
        return run_by(sd.minimise, problem, problem.loss, None)
    return run_by(sd.least_squares, problem, problem.residuals, None)


def shortest_with_keys(problem: Problem) -> Solve:
    """Likewise, of a function that takes a key: the noise is another at each step."""
    if problem.keyed is None:
        raise NotAble("needs residuals whose noise follows from a key")
    return run_by(sd.least_squares, problem, problem.keyed, None, takes_key=True)


METHODS = {
    "shortest_call": MethodEntry("The shortest call (ours)", (), shortest),
    "shortest_call_keys": MethodEntry(
        "The shortest call, fresh noise (ours)", ("scene",), shortest_with_keys
    ),
    "first_order": MethodEntry("First order (ours)", ("scene", "large", "program"), first_order),
    "newton_cg": MethodEntry("Newton-CG (ours)", ("scene", "program", "function"), newton_cg),
    "gauss_newton": MethodEntry(
        "Gauss-Newton on residuals (ours)",
        ("scene", "large", "program", "function"),
        gauss_newton,
    ),
    "local_gauss_newton": MethodEntry(
        "Gauss-Newton, local support (ours)", ("large", "program"), local_gauss_newton
    ),
}
