"""Grey boxes: a network by AD, and behind it a black box by one or another estimator; with Adam.

Appendix E of the paper on higher-order rendering: what the black box says of its few parameters is
pulled back through the network to its weights. A step sees a few cases, and each case has samples
of its own. Estimators differ in nothing else; sigma is annealed as in the papers (Table 3).
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax

import smoothdiff as sd
from benchmarks._task import MethodEntry, NotAble, Problem, Solve
from benchmarks.methods._flat import Flat

BATCH = 8  # cases in a step
RATE, DECAY = 1e-3, 0.02  # of Adam on the weights, and what is left of it at the end
SIGMA_END = 0.1  # of the first sigma
STEP = 0.3  # of finite differences, in units of sigma

Estimate = Callable[..., jax.Array]  # (black, sigma, key, x, case) -> the slope at x
Cost = Callable[[int], int]  # evaluations for so many parameters


def prepare(problem: Problem, estimate: Estimate, cost: Cost) -> Solve:
    """Compiles a step."""
    grey = problem.grey
    if grey is None:
        raise NotAble("this task has no part that AD knows")
    flat = Flat(problem)
    parameters = jax.eval_shape(grey.white, problem.like, grey.cases[0]).size
    steps = problem.budget.evaluations // (BATCH * cost(parameters))
    optim = optax.adam(optax.linear_schedule(RATE, DECAY * RATE, steps))
    sigma_at = optax.linear_schedule(grey.sigma, SIGMA_END * grey.sigma, steps)

    @jax.jit
    def step(key: jax.Array, i: jax.Array, x: jax.Array, state: Any) -> tuple[Any, Any]:
        draw, *keys = jax.random.split(key, BATCH + 1)
        cases = jax.random.choice(draw, grey.cases, (BATCH,), replace=False)
        white = lambda x: jax.vmap(partial(grey.white, flat.unravel(x)))(cases)
        inner, pull = jax.vjp(white, x)
        slopes = jax.vmap(partial(estimate, grey.black, sigma_at(i)))(jnp.stack(keys), inner, cases)
        updates, state = optim.update(pull(slopes / BATCH)[0], state, x)
        return optax.apply_updates(x, updates), state

    return flat.iterate(step, optim.init)


def _smoothed(smooth_grad: Callable[..., Any] = sd.smooth_grad, **options: Any) -> Estimate:
    def estimate(black, sigma, key, x, case):
        return smooth_grad(black, sigma, **options)(key, x, case)

    return estimate


def _differences(black, sigma, key, x, case):
    """Central, the same for every key."""
    step = STEP * sigma

    def slope(along):
        return (black(x + step * along, case) - black(x - step * along, case)) / (2 * step)

    return jax.vmap(slope)(jnp.eye(x.size, dtype=x.dtype))


def _entry(estimator: str, estimate: Estimate, cost: Cost) -> MethodEntry:
    title = f"Network by AD, renderer by {estimator}"
    return MethodEntry(title, ("network",), partial(prepare, estimate=estimate, cost=cost))


FR22 = _smoothed(num_samples=2, baseline="none", sampler=sd.Gaussian(antithetic=True))
WANG_G = _smoothed(sd.Importance(1), num_samples=2, baseline="none")
AGGREGATE = _smoothed(num_samples=2, baseline="none", sampler=sd.Aggregate(1, share=0.0))
METHODS = {
    "grey_differences": _entry("finite differences", _differences, lambda n: 2 * n),
    "grey_fr22": _entry("FR22", FR22, lambda n: 2),
    "grey_wang_g": _entry("Wang-G", WANG_G, lambda n: 2 * n),
    "grey_aggregate": _entry("Wang-G aggregate", AGGREGATE, lambda n: 2),
    "grey_ours": _entry("smooth_grad (ours)", _smoothed(num_samples=4), lambda n: 4),
}
