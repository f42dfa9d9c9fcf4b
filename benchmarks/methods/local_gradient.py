"""The smoothed gradient with local support, and Adam. Sigma begins wide and falls geometrically.

Each parameter sees only the noise of its own terms, so sigma can be half of the domain at first,
where the wrong valleys are not seen yet. It falls over a number of evaluations that is the same for
all tasks, and steps fall with it.
"""

import itertools

import jax
import jax.numpy as jnp
import optax

import smoothdiff as sd
from benchmarks._task import Solve, Task
from benchmarks.methods._local import local

TITLE = "Smoothed gradient, local support, Adam (ours)"
NUM_SAMPLES = 8
SIGMA, SIGMA_END = 0.5, 0.003  # of the domain
EVALUATIONS = 450  # until sigma has fallen
STEP = 0.7  # in units of sigma
BETAS = 0.5, 0.9  # a short memory, as sigma falls fast


def prepare(task: Task) -> Solve:
    """Compiles a step."""
    flat, terms, support = local(task)
    optim = optax.scale_by_adam(*BETAS)
    steps = EVALUATIONS // NUM_SAMPLES
    share_at = optax.exponential_decay(SIGMA, steps, SIGMA_END / SIGMA, end_value=SIGMA_END)

    @jax.jit
    def step(key, x, state, i):
        sigma = jnp.asarray(share_at(i), flat.dtype) * (flat.high - flat.low)
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
        return flat.clip(x - STEP * sigma * jnp.asarray(direction)), state

    def solve(y0, key, record):
        x = jnp.asarray(flat.start(y0), flat.dtype)
        state = optim.init(x)
        for i in itertools.count():
            x, state = step(jax.random.fold_in(key, i), x, state, i)
            record(flat.tree(x))

    return solve
