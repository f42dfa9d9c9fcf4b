"""The smoothed gradient with local support, and Adam. Sigma falls geometrically, and steps with it.

Each parameter sees only the noise of its own terms, so few samples are enough for thousands of
parameters. What differs is where sigma begins:

* at half of the domain, where wrong valleys are not seen yet, and in few evaluations, the same
  number for all tasks;
* at the task's sigma, and over the budget, as for `first_order`, which has no support.
"""

import itertools
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

import smoothdiff as sd
from benchmarks._task import Solve, Task
from benchmarks.methods._flat import Flat
from benchmarks.methods._local import local
from benchmarks.methods.first_order import BETAS, RATE, SIGMA_END

NUM_SAMPLES = 8
WIDEST, NARROWEST = 0.5, 0.003  # of the domain
EVALUATIONS = 450  # until sigma has fallen


class Course(NamedTuple):
    """How a run goes: sigma after so many steps, the step in units of it, and Adam's memory."""

    sigma: Any
    step: float
    betas: tuple[float, float]


def from_the_domain(task: Task, flat: Flat) -> Course:
    """Fast, with a short memory, as sigma falls fast."""
    steps = EVALUATIONS // NUM_SAMPLES
    share = optax.exponential_decay(WIDEST, steps, NARROWEST / WIDEST, end_value=NARROWEST)
    domain = flat.high - flat.low
    return Course(lambda i: jnp.asarray(share(i), flat.dtype) * domain, 0.7, (0.5, 0.9))


def from_the_sigma(task: Task, flat: Flat) -> Course:
    """As `first_order`."""
    steps = task.budget.evaluations // NUM_SAMPLES
    share = optax.exponential_decay(1.0, steps, SIGMA_END, end_value=SIGMA_END)
    return Course(lambda i: jnp.asarray(share(i) * task.sigma, flat.dtype), RATE, BETAS)


def prepare(task: Task, plan: Any) -> Solve:
    """Compiles a step."""
    flat, terms, support = local(task)
    course: Course = plan(task, flat)
    optim = optax.scale_by_adam(*course.betas)

    @jax.jit
    def step(key, x, state, i):
        sigma = course.sigma(i)
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
        return flat.clip(x - course.step * sigma * jnp.asarray(direction)), state

    def solve(y0, key, record):
        x = jnp.asarray(flat.start(y0), flat.dtype)
        state = optim.init(x)
        for i in itertools.count():
            x, state = step(jax.random.fold_in(key, i), x, state, i)
            record(flat.tree(x))

    return solve


VARIANTS = {
    "local_gradient": (
        "Smoothed gradient, local support, Adam (ours)",
        partial(prepare, plan=from_the_domain),
    ),
    "local_first_order": (
        "First order, local support (ours)",
        partial(prepare, plan=from_the_sigma),
    ),
}
