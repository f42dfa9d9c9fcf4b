"""Grey boxes: a network by AD, and behind it a black box by one or another estimator; with Adam.

Appendix E of the paper on higher-order rendering: what the black box says of its few parameters is
pulled back through the network to its weights. A step sees a few cases, and each case has samples
of its own. Estimators differ in nothing else; sigma is annealed as in the papers (Table 3).
"""

import itertools
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax

import smoothdiff as sd
from benchmarks._task import Grey, NotAble, Solve, Task

BATCH = 8  # cases in a step
RATE, DECAY = 1e-3, 0.02  # of Adam on the weights, and what is left of it at the end
SIGMA_END = 0.1  # of the first sigma
STEP = 0.3  # of finite differences, in units of sigma

Estimate = Callable[..., jax.Array]  # (black, sigma, key, x, case) -> the slope at x
Cost = Callable[[int], int]  # evaluations for so many parameters


def prepare(task: Task, estimate: Estimate, cost: Cost) -> Solve:
    """Compiles a step."""
    if task.grey is None:
        raise NotAble("this task has no part that AD knows")
    grey: Grey = task.grey
    parameters = jax.eval_shape(grey.white, task.reference, grey.cases[0]).size
    steps = task.budget.evaluations // (BATCH * cost(parameters))
    optim = optax.adam(optax.linear_schedule(RATE, DECAY * RATE, steps))
    sigma_at = optax.linear_schedule(grey.sigma, SIGMA_END * grey.sigma, steps)

    @jax.jit
    def step(key: jax.Array, y: jax.Array, state: Any, i: jax.Array) -> tuple[Any, Any]:
        draw, *keys = jax.random.split(jax.random.fold_in(key, i), BATCH + 1)
        cases = jax.random.choice(draw, grey.cases, (BATCH,), replace=False)
        inner, pull = jax.vjp(lambda y: jax.vmap(partial(grey.white, y))(cases), y)
        slopes = jax.vmap(partial(estimate, grey.black, sigma_at(i)))(jnp.stack(keys), inner, cases)
        updates, state = optim.update(pull(slopes / BATCH)[0], state, y)
        return optax.apply_updates(y, updates), state

    def solve(y0, key, record):
        y, state = y0, optim.init(y0)
        for i in itertools.count():
            y, state = step(key, y, state, jnp.asarray(i))
            record(y)

    return solve


def _smoothed(**options: Any) -> Estimate:
    def estimate(black, sigma, key, x, case):
        return sd.smooth_grad(black, sigma, **options)(key, x, case)

    return estimate


def _differences(black, sigma, key, x, case):
    """Central, the same for every key."""
    step = STEP * sigma

    def slope(along):
        return (black(x + step * along, case) - black(x - step * along, case)) / (2 * step)

    return jax.vmap(slope)(jnp.eye(x.size, dtype=x.dtype))


def _variant(title: str, estimate: Estimate, cost: Cost) -> tuple[str, Callable[[Task], Solve]]:
    return title, partial(prepare, estimate=estimate, cost=cost)


PAIR = {"num_samples": 2, "baseline": "none"}
VARIANTS = {
    "grey_differences": _variant(
        "Network by AD, renderer by finite differences", _differences, lambda n: 2 * n
    ),
    "grey_fr22": _variant(
        "Network by AD, renderer by FR22",
        _smoothed(sampler=sd.Gaussian(antithetic=True), **PAIR),
        lambda n: 2,
    ),
    "grey_our_gradient": _variant(
        "Network by AD, renderer by OurG",
        _smoothed(sampler=sd.Importance(1), **PAIR),
        lambda n: 2 * n,
    ),
    "grey_aggregate": _variant(
        "Network by AD, renderer by OurG aggregate",
        _smoothed(sampler=sd.Aggregate(1, share=0.0), **PAIR),
        lambda n: 2,
    ),
    "grey_ours": _variant(
        "Network by AD, renderer by smooth_grad (ours)", _smoothed(num_samples=4), lambda n: 4
    ),
}
