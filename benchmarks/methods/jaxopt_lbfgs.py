"""L-BFGS as in jaxopt, on a smoothed loss that a fixed key makes deterministic.

Each round of L-BFGS has samples of its own and a sigma smaller than the last.
"""

import itertools

import jax
import jax.numpy as jnp

import smoothdiff as sd
from benchmarks._task import Solve, Task
from benchmarks.methods._flat import Flat, package

TITLE = "L-BFGS on a smoothed loss, fixed key (jaxopt)"
NUM_SAMPLES = 16
SHRINK, NARROWEST = 0.5, 0.01  # of sigma from round to round, and the last, of the task's
STEPS = 10  # in a round
TOLERANCE = 1e-3  # of the gradient, as a share of the first one of the round


def prepare(task: Task) -> Solve:
    """Compiles a step of L-BFGS once, for all rounds."""
    jaxopt = package("jaxopt", "jaxopt")
    flat = Flat(task)

    def fun(u, key, sigma, unit):
        smoothed = sd.smooth(
            lambda u: flat.loss(task.sigma * u),
            sigma,
            num_samples=NUM_SAMPLES,
            sampler=sd.Gaussian(antithetic=True),
            baseline="mean",
        )
        return smoothed(key, u) / unit

    solver = jaxopt.LBFGS(fun, linesearch="zoom", maxls=10)
    init = jax.jit(solver.init_state)
    step = jax.jit(solver.update)
    slope = jax.jit(lambda *args: jnp.linalg.norm(jax.grad(fun)(*args, jnp.ones((), flat.dtype))))

    def solve(y0, key, record):
        u = jnp.asarray(flat.start(y0) / task.sigma, flat.dtype)
        for i in itertools.count():
            sigma = jnp.asarray(max(SHRINK**i, NARROWEST), flat.dtype)
            args = jax.random.fold_in(key, i), sigma
            unit = slope(u, *args)
            args += (jnp.where(unit > 0, unit, 1),)
            state = init(u, *args)
            for _ in range(STEPS):
                u, state = step(u, state, *args)
                u = flat.clip(task.sigma * u) / task.sigma
                record(flat.tree(task.sigma * u))
                if state.error <= TOLERANCE:
                    break

    return solve
