"""Newton's method on the papers' sampled gradient and Hessian (HODR, eq. 3 and appendix H).

Plain, $x \\mathrel{-}= H^{-1} g$ goes wherever a Hessian that is singular, indefinite or noisy
sends it. Modified, a multiple of the identity is added until the Hessian is positive definite, and
the step is cut to a trust region of the radius of OurH.
"""

import itertools
from functools import partial

import jax
import jax.numpy as jnp

from benchmarks._task import Solve, Task
from benchmarks.methods import _published as published
from benchmarks.methods._flat import Flat

RADIUS = 3.0  # in units of the current sigma: the median of OurH's row in table 3
FLOOR = 1e-3  # the lowest eigenvalue after the modification, of the largest magnitude


def prepare(task: Task, modified: bool) -> Solve:
    """Compiles one iteration."""
    flat = Flat(task)
    gradient, hessian = published.gradient(flat, aggregate=False), published.hessian(flat)
    evaluations = gradient.evaluations + hessian.evaluations

    @jax.jit
    def step(key, sigma, x):
        keys = jax.random.split(key)
        g, h = gradient.call(keys[0], sigma, x), hessian.call(keys[1], sigma, x)
        values, vectors = jnp.linalg.eigh(h)
        largest = jnp.max(jnp.abs(values))
        if modified:
            values = values + jnp.maximum(FLOOR * largest - values[0], 0)
        seen = jnp.abs(values) > 1e-6 * largest  # the pseudo-inverse leaves the others alone
        along = jnp.where(seen, (g @ vectors) / jnp.where(seen, values, 1), 0)
        p = -vectors @ along
        if modified:
            length = jnp.linalg.norm(p)
            p = p * jnp.where(length > RADIUS * sigma, RADIUS * sigma / length, 1)
        return flat.clip(x + p)

    def solve(y0, key, record):
        x = jnp.asarray(flat.start(y0), flat.dtype)
        for i in itertools.count():
            sigma = published.sigma_at(task, flat, i * evaluations)
            x = step(jax.random.fold_in(key, i), sigma, x)
            record(flat.tree(x))

    return solve


VARIANTS = {
    "newton": ("Newton", partial(prepare, modified=False)),
    "newton_modified": ("Newton, modified Hessian, trust region", partial(prepare, modified=True)),
}
