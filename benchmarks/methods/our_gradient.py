"""OurG of the higher-order paper: the importance-sampled gradient (eq. 17), with Adam.

A set of samples for each parameter; Adam is the same as for all first-order methods here.
"""

import itertools

import jax
import jax.numpy as jnp

from benchmarks._task import Solve, Task
from benchmarks.methods import _published as published
from benchmarks.methods._adam import optimiser
from benchmarks.methods._flat import Flat

TITLE = "Importance-sampled gradient, Adam (OurG)"


def prepare(task: Task) -> Solve:
    """Compiles the gradient and the update."""
    flat = Flat(task)
    gradient = published.gradient(flat, aggregate=False)
    optim = optimiser(task, gradient.evaluations)

    @jax.jit
    def step(key, sigma, x, state):
        updates, state = optim.update(gradient.call(key, sigma, x), state, x)
        return flat.clip(x + updates), state

    def solve(y0, key, record):
        x = jnp.asarray(flat.start(y0), flat.dtype)
        state = optim.init(x)
        for i in itertools.count():
            sigma = published.sigma_at(task, flat, i * gradient.evaluations)
            x, state = step(jax.random.fold_in(key, i), sigma, x, state)
            record(flat.tree(x))

    return solve
