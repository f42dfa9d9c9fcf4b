"""Searches with local support: each parameter is judged by the terms that it may influence alone.

So it sees only their noise, and few samples are enough for thousands of parameters.

`local_gradient` and `local_first_order` are the smoothed gradient and Adam. Sigma falls
geometrically, and steps with it. What differs is where sigma begins:

* at half of the domain, where wrong valleys are not seen yet, and in few evaluations, the same
  number for all tasks;
* at the problem's sigma, and over the budget, as for `first_order`, which has no support.

`local_cross_entropy` is the solver `LocalCrossEntropy`.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optax

import smoothdiff as sd
from benchmarks._task import MethodEntry, NotAble, Problem, Solve
from benchmarks.methods._flat import Flat
from benchmarks.methods._host_loop import run_by
from benchmarks.methods.our_solvers import BETAS, RATE, SIGMA_END
from smoothdiff._support import AbstractSupport, as_support

NUM_SAMPLES = 8
WIDEST, NARROWEST = 0.5, 0.003  # of the domain
EVALUATIONS = 450  # until sigma has fallen


def local(problem: Problem) -> tuple[Flat, Callable[[jax.Array], jax.Array], AbstractSupport]:
    """The problem in flat vectors: itself, its terms within the bounds, and which to blame.

    The support may depend on where it is, so it is asked for `at` a vector.
    """
    terms, support = problem.terms, as_support(problem.support)
    if terms is None or support is None:
        raise NotAble("needs a loss that is a sum of terms with a local support")
    flat = Flat(problem)
    around = lambda x: lambda params: support.at(flat.unravel(x))(flat.unravel(params))
    return flat, lambda x: terms(flat.tree(x)), sd.moving_support(around)


def from_the_domain(problem: Problem) -> Solve:
    """Fast, with a short memory, as sigma falls fast."""
    steps = EVALUATIONS // NUM_SAMPLES
    share = optax.exponential_decay(WIDEST, steps, NARROWEST / WIDEST, end_value=NARROWEST)
    low, high = Flat(problem).box
    return descend(problem, share, high - low, rate=0.7, betas=(0.5, 0.9))


def from_the_sigma(problem: Problem) -> Solve:
    """As `first_order`."""
    steps = problem.budget.evaluations // NUM_SAMPLES
    share = optax.exponential_decay(1.0, steps, SIGMA_END, end_value=SIGMA_END)
    return descend(problem, share, problem.sigma, RATE, BETAS)


def descend(
    problem: Problem,
    share: optax.Schedule,
    unit: float | np.ndarray,
    rate: float,
    betas: tuple[float, float],
) -> Solve:
    """Compiles a step of Adam, of `rate` sigma; sigma is a share of a unit."""
    flat, terms, support = local(problem)
    optim = optax.scale_by_adam(*betas)

    @jax.jit
    def step(key, i, x, state):
        sigma = jnp.asarray(share(i), flat.dtype) * jnp.asarray(unit, flat.dtype)
        grad = sd.smooth_grad(
            terms,
            sigma,
            num_samples=NUM_SAMPLES,
            sampler=sd.Gaussian(antithetic=True),
            baseline="mean",
            support=support,
            bounds=(flat.low, flat.high),
        )
        direction, state = optim.update(grad(key, x), state)
        return flat.clip(x - rate * sigma * jnp.asarray(direction)), state

    return flat.iterate(step, optim.init)


def cross_entropy(problem: Problem) -> Solve:
    """Ours by its defaults, over the whole domain."""
    if problem.residuals is None or problem.support is None:
        raise NotAble("needs residuals with a local support")
    solver = sd.LocalCrossEntropy(problem.support)
    return run_by(sd.least_squares, problem, problem.residuals, solver)


KINDS = ("large", "program")
METHODS = {
    "local_gradient": MethodEntry(
        "Smoothed gradient, local support, Adam (ours)", KINDS, from_the_domain
    ),
    "local_first_order": MethodEntry("First order, local support (ours)", KINDS, from_the_sigma),
    "local_cross_entropy": MethodEntry(
        "Cross-entropy search, local support (ours)", KINDS, cross_entropy
    ),
}
