"""Searches with local support: each parameter is judged by the terms that it may influence alone.

So it sees only their noise, and few samples are enough for thousands of parameters.

`local_gradient` and `local_first_order` are the smoothed gradient and Adam. Sigma falls
geometrically, and steps with it. What differs is where sigma begins:

* at half of the domain, where wrong valleys are not seen yet, and in few evaluations, the same
  number for all tasks;
* at the problem's sigma, and over the budget, as for `first_order`, which has no support.

`local_cross_entropy` is one cross-entropy search in one dimension for each parameter; all share
their evaluations. Next is a normal population, with the mean and the spread of the best quarter of
the last one. The first is spread evenly over the bounds, whatever the start, so no search begins in
the wrong valley.

    R. Y. Rubinstein: The Cross-Entropy Method for Combinatorial and Continuous Optimization.
    Methodology and Computing in Applied Probability 1 (1999).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optax

import smoothdiff as sd
from benchmarks._task import MethodEntry, NotAble, Problem, Solve
from benchmarks.methods._flat import Flat
from benchmarks.methods.our_solvers import BETAS, RATE, SIGMA_END
from smoothdiff._support import AbstractSupport, as_support

NUM_SAMPLES = 8
WIDEST, NARROWEST = 0.5, 0.003  # of the domain
EVALUATIONS = 450  # until sigma has fallen
POPULATION = 32
ELITE = 8
SHARE = 0.7  # of the new mean and spread; the rest is that of the generation before


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
    """Compiles a generation."""
    flat, terms, support = local(problem)
    shape = POPULATION, flat.size

    def fit(points, middle):
        """Mean and spread of the elite of each parameter; who is as good as the last is in it."""
        blame = jax.linear_transpose(support.at(middle), middle)
        found = jax.vmap(lambda x: blame(terms(x))[0])(points)
        worst = jnp.sort(found, axis=0)[ELITE - 1]
        weights = (found <= worst).astype(flat.dtype)
        weights = weights / weights.sum(0)
        mean = jnp.sum(weights * points, 0)
        variance = jnp.sum(weights * (points - mean) ** 2, 0) * ELITE / (ELITE - 1)
        return mean, jnp.sqrt(variance)

    @jax.jit
    def begin(key):
        layer, place = jax.random.split(key)
        numbers = jnp.broadcast_to(jnp.arange(POPULATION, dtype=flat.dtype)[:, None], shape)
        shuffled = jax.random.permutation(layer, numbers, independent=True)
        even = (shuffled + jax.random.uniform(place, shape, flat.dtype)) / POPULATION
        points = flat.low + (flat.high - flat.low) * even
        return fit(points, (flat.low + flat.high) / 2)

    @jax.jit
    def generation(key, mean, spread):
        z = jax.random.normal(key, shape, flat.dtype)
        new = fit(flat.clip(mean + spread * z), mean)
        blend = lambda old, new: (1 - SHARE) * old + SHARE * new
        return jax.tree.map(blend, (mean, spread), new)

    def step(key, i, mean, spread):
        return begin(key) if i == 0 else generation(key, mean, spread)

    return flat.iterate(step, lambda x: None)


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
