"""optax.perturbations with Adam: what a user of optax has at hand, with Gaussian noise.

As with the smoothed gradient of FR22, sigma falls linearly over the budget. A step is a few samples
and the value at the point itself, which optax subtracts from theirs.
"""

from typing import Any

import jax
import jax.numpy as jnp
import optax
from optax import perturbations

from benchmarks._task import MethodEntry, Problem, Solve
from benchmarks.methods._adam import adam
from benchmarks.methods._flat import Flat

NUM_SAMPLES = 3
SIGMA_END = 0.1  # of the problem's sigma


def prepare(problem: Problem) -> Solve:
    """Compiles the gradient once for all starts."""
    flat = Flat(problem)
    evaluations = NUM_SAMPLES + 1
    steps = problem.budget.evaluations // evaluations
    sigma_at = optax.linear_schedule(problem.sigma, SIGMA_END * problem.sigma, steps)
    smooth: Any = perturbations.make_perturbed_fun  # it takes more than its annotations say

    @jax.jit
    def gradient(key, i, x):
        sigma = jnp.asarray(sigma_at(i), flat.dtype)
        smoothed = smooth(flat.loss, NUM_SAMPLES, sigma, perturbations.Normal())
        return jax.grad(smoothed, argnums=1)(key, x)

    return adam(flat, gradient, evaluations)


METHODS = {
    "optax_perturbations": MethodEntry("optax.perturbations, Adam", ("scene",), prepare),
}
