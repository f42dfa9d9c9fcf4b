"""Adam on the gradients that others use: differences, a renderer's own, and smoothed ones.

All first-order methods here have one learning rate, linearly decayed over the budget: the best
compromise of smoothed gradients on shadow and Box10, from 0.03 to 0.25 sigma.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from optax import perturbations

import smoothdiff as sd
from benchmarks._task import Key, MethodEntry, NotAble, Problem, Solve
from benchmarks.methods._flat import Flat
from benchmarks.methods._host_loop import run_by

LEARNING_RATE = 0.15  # in units of the problem's sigma
DECAY = 0.02  # what is left of it at the end
SIGMA_END = 0.1  # of the problem's sigma, of smoothed gradients
# of finite differences, in units of sigma: wide enough to reach the reference of shadow from every
# start. With 0.1 or 0.02 they see the noise of the render, and stay on the plateau from some
STEP = 0.3
BATCH = 64  # parameters at once, which bounds the memory
PAIR = 2  # samples of FR22
NUM_SAMPLES = 3  # of optax.perturbations, which subtracts the value at the point itself


def optimiser(
    problem: Problem, evaluations_per_step: int, rate: float = LEARNING_RATE
) -> optax.GradientTransformation:
    """Adam for a problem, for a method that spends so many evaluations on a step."""
    steps, first = problem.budget.evaluations // evaluations_per_step, rate * problem.sigma
    return optax.adam(optax.linear_schedule(first, DECAY * first, steps))


def adam(
    flat: Flat,
    gradient: Callable[[Key, int, jax.Array], jax.Array],
    evaluations_per_step: int,
    rate: float = LEARNING_RATE,
) -> Solve:
    """Adam on `gradient(key, i, x)` of step i, within the bounds; it is called as it is."""
    optim = optimiser(flat.problem, evaluations_per_step, rate)

    @jax.jit
    def move(x, state, slope):
        updates, state = optim.update(slope, state, x)
        return flat.clip(x + updates), state

    return flat.iterate(lambda key, i, x, state: move(x, state, gradient(key, i, x)), optim.init)


def finite_differences(
    problem: Problem, *, rate: float = LEARNING_RATE, step: float = STEP
) -> Solve:
    """Central ones; they need nothing but the loss, also beyond the bounds."""
    flat, step = Flat(problem), step * problem.sigma
    evaluations = 2 * flat.size
    if evaluations > problem.budget.evaluations:
        raise NotAble(f"needs {evaluations:,} evaluations for its first step")

    @jax.jit
    def gradient(x):
        def slope(i):
            shifted = (flat.unravel(x.at[i].add(shift)) for shift in (step, -step))
            forward, backward = map(problem.loss, shifted)
            return (forward - backward) / (2 * step)

        return jax.lax.map(slope, jnp.arange(flat.size), batch_size=BATCH)

    return adam(flat, lambda key, i, x: gradient(x), evaluations, rate)


def native(problem: Problem, *, rate: float = LEARNING_RATE) -> Solve:
    """The renderer's own automatic differentiation: what one uses where it works."""
    if problem.native_ad is None:
        raise NotAble("this task has no derivative of its own")
    flat, value_and_grad = Flat(problem), problem.native_ad()
    gradient = lambda key, i, x: ravel_pytree(value_and_grad(flat.tree(x))[1])[0]
    return adam(flat, gradient, evaluations_per_step=2, rate=rate)


def sigma_at(problem: Problem, evaluations_per_step: int, end: float = SIGMA_END) -> optax.Schedule:
    """Annealed linearly over the budget, as in the paper of FR22."""
    steps = problem.budget.evaluations // evaluations_per_step
    return optax.linear_schedule(problem.sigma, end * problem.sigma, steps)


def fr22_solver(
    problem: Problem,
    directions: type[sd.Gaussian] = sd.Gaussian,
    *,
    rate: float = LEARNING_RATE,
    sigma_end: float = SIGMA_END,
) -> sd.FirstOrder:
    """After Fischer and Ritschel 2022: samples in antithetic pairs, nothing is subtracted."""
    return sd.FirstOrder(
        optimiser(problem, PAIR, rate),
        sigma_at(problem, PAIR, sigma_end),
        num_samples=PAIR,
        sampler=directions(antithetic=True),
        baseline="none",
    )


def fr22(problem: Problem, **settings: Any) -> Solve:
    """One solver and one function for all starts, so that they are compiled once."""
    return run_by(sd.minimise, problem, problem.loss, fr22_solver(problem, **settings))


def fr22_with_keys(problem: Problem) -> Solve:
    """Likewise, of a function that takes a key: the noise is another at each step."""
    keyed = problem.keyed
    if keyed is None:
        raise NotAble("needs residuals whose noise follows from a key")
    loss = lambda y, key: jnp.mean(keyed(y, key) ** 2)
    return run_by(sd.minimise, problem, loss, fr22_solver(problem), takes_key=True)


def optax_perturbations(
    problem: Problem, *, rate: float = LEARNING_RATE, num_samples: int = NUM_SAMPLES
) -> Solve:
    """What a user of optax has at hand, with Gaussian noise; sigma falls as for FR22."""
    flat, evaluations = Flat(problem), num_samples + 1
    sigma = sigma_at(problem, evaluations)
    smooth: Any = perturbations.make_perturbed_fun  # it takes more than its annotations say

    @jax.jit
    def gradient(key, i, x):
        width = jnp.asarray(sigma(i), flat.dtype)
        smoothed = smooth(flat.loss, num_samples, width, perturbations.Normal())
        return jax.grad(smoothed, argnums=1)(key, x)

    return adam(flat, gradient, evaluations, rate)


RATES = (0.15, 0.3, 0.6)  # grids begin from the one setting for all, and go on as far as they pay
METHODS = {
    "finite_differences": MethodEntry(
        "Finite differences, Adam",
        ("scene", "program", "function"),
        finite_differences,
        {"rate": RATES, "step": (0.1, 0.3, 0.9)},
    ),
    "mitsuba_ad": MethodEntry("Mitsuba AD, Adam", ("scene",), native, {"rate": RATES}),
    "fr22_keys": MethodEntry("FR22, fresh noise", ("scene",), fr22_with_keys),
    "fr22": MethodEntry(
        "Smoothed gradient, Adam (FR22)",
        ("scene", "large", "program", "function"),
        fr22,
        {"rate": RATES, "sigma_end": (0.03, 0.1, 0.3)},
    ),
    "optax_perturbations": MethodEntry(
        "optax.perturbations, Adam",
        ("scene",),
        optax_perturbations,
        {"rate": RATES, "num_samples": (1, 3, 6)},
    ),
}
