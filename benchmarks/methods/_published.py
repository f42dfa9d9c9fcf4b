"""The papers' estimators of derivatives, at one setting for all tasks.

Table 3 of Stochastic Gradient Estimation for Higher-order Differentiable Rendering has a setting
for each task, chosen as the best. As here one setting serves all tasks, it is the median over the
table's nine tasks, in units of the first sigma: two antithetic pairs, and a sigma that ends at 2 %
and falls linearly (appendix L) with the evaluations used. The aggregate sampler draws six pairs, as
the table has it for Box2 and Box10: with two it finds little. Nothing is subtracted.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

import smoothdiff as sd
from benchmarks._task import Task
from benchmarks.methods._flat import Flat

PER_ELEMENT = 4  # samples
AGGREGATE = 12  # samples for all elements together
SIGMA_END = 0.02  # of the task's sigma
SHIFT = 1 / 3  # epsilon |v| of eq. 8, in units of sigma, as in the authors' code


class Derivative(NamedTuple):
    """A derivative of the smoothed loss of a flat vector, compiled, and what it costs."""

    call: Callable[..., jax.Array]
    evaluations: int


def gradient(flat: Flat, *, aggregate: bool) -> Derivative:
    """`(key, sigma, x) -> vector`, eq. 17: elementwise or aggregate importance sampling."""
    grad = lambda sigma: sd.smooth_grad(flat.loss, sigma, **_first_order(aggregate))
    call = jax.jit(lambda key, sigma, x: grad(sigma)(key, x))
    return Derivative(call, AGGREGATE if aggregate else PER_ELEMENT * flat.size)


def product(flat: Flat, *, aggregate: bool) -> Derivative:
    """`(key, sigma, x, v) -> vector`, eq. 8 and 23: the difference of two sampled gradients.

    Both see the same random numbers; drawn independently, their difference is noise.
    """

    @jax.jit
    def call(key, sigma, x, v):
        grad = sd.smooth_grad(flat.loss, sigma, **_first_order(aggregate))
        length = jnp.maximum(jnp.linalg.norm(v), jnp.finfo(v.dtype).tiny)
        along = sd.difference_hvp(grad, SHIFT)(key, x, v * (sigma / length))
        return along * (length / sigma)

    return Derivative(call, 2 * gradient(flat, aggregate=aggregate).evaluations)


def hessian(flat: Flat) -> Derivative:
    """`(key, sigma, x) -> matrix`, eq. 20, elementwise: n (n + 1) / 2 sets of samples."""
    options = {"num_samples": PER_ELEMENT, "sampler": sd.Importance(2), "baseline": "none"}
    full = lambda sigma: sd.smooth_hessian(flat.loss, sigma, **options)
    call = jax.jit(lambda key, sigma, x: full(sigma)(key, x))
    return Derivative(call, PER_ELEMENT * flat.size * (flat.size + 1) // 2)


def sigma_at(task: Task, flat: Flat, evaluations: int) -> jax.Array:
    """The sigma after so many evaluations, of those that the task allows."""
    used = min(evaluations / task.budget.evaluations, 1)
    return jnp.asarray(task.sigma * (1 - (1 - SIGMA_END) * used), flat.dtype)


def _first_order(aggregate: bool) -> dict:
    if aggregate:
        chosen = {"num_samples": AGGREGATE, "sampler": sd.Aggregate(1, share=0.0)}
    else:
        chosen = {"num_samples": PER_ELEMENT, "sampler": sd.Importance(1)}
    return chosen | {"baseline": "none"}
