"""optax.perturbations with Adam: what a user of optax has at hand, with Gaussian noise.

As with the smoothed gradient of FR22, sigma falls linearly over the budget. A step is a few samples
and the value at the point itself, which optax subtracts from theirs.
"""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import optax
from optax import perturbations

from benchmarks._task import Solve, Task
from benchmarks.methods._adam import optimiser
from benchmarks.methods._flat import Flat

TITLE = "optax.perturbations, Adam"
NUM_SAMPLES = 3
SIGMA_END = 0.1  # of the task's sigma


def prepare(task: Task) -> Solve:
    """Compiles one step for all starts."""
    flat = Flat(task)
    per_step = NUM_SAMPLES + 1
    optim = optimiser(task, per_step)
    smooth: Any = perturbations.make_perturbed_fun  # it takes more than its annotations say
    sigma_at = optax.linear_schedule(
        task.sigma, SIGMA_END * task.sigma, task.budget.evaluations // per_step
    )

    @jax.jit
    def step(key, x, state, i):
        sigma = jnp.asarray(sigma_at(i), flat.dtype)
        smoothed = smooth(flat.loss, NUM_SAMPLES, sigma, perturbations.Normal())
        updates, state = optim.update(jax.grad(smoothed, argnums=1)(key, x), state, x)
        return flat.clip(x + jnp.asarray(updates)), state

    def solve(y0, key, record):
        x = jnp.asarray(flat.start(y0), flat.dtype)
        state = optim.init(x)
        for i in itertools.count():
            x, state = step(jax.random.fold_in(key, i), x, state, i)
            record(flat.tree(x))

    return solve
