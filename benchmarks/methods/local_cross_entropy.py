"""Cross-entropy search with local support: one search in one dimension for each parameter.

All searches share their evaluations: a parameter scores a point by the sum of the terms that it may
influence. Next is a normal population, with the mean and the spread of the best quarter of the last
one, for each parameter by itself. The first is spread evenly over the bounds, whatever the start,
so no search begins in the wrong valley.

    R. Y. Rubinstein: The Cross-Entropy Method for Combinatorial and Continuous Optimization.
    Methodology and Computing in Applied Probability 1 (1999).
"""

import itertools

import jax
import jax.numpy as jnp

from benchmarks._task import Solve, Task
from benchmarks.methods._local import local

TITLE = "Cross-entropy search, local support (ours)"
POPULATION = 32
ELITE = 8
SHARE = 0.7  # of the new mean and spread; the rest is that of the generation before


def prepare(task: Task) -> Solve:
    """Compiles a generation."""
    flat, terms, support = local(task)

    def fit(points, middle):
        """Mean and spread of the elite of each parameter; who is as good as the last is in it."""
        blame = jax.linear_transpose(support.at(middle), middle)
        found = jax.vmap(lambda x: blame(terms(x))[0])(points)
        worst = jnp.sort(found, axis=0)[ELITE - 1]
        weights = (found <= worst).astype(flat.dtype)
        weights = weights / weights.sum(0)
        mean = jnp.sum(weights * points, 0)
        variance = jnp.sum(weights * (points - mean) ** 2, 0) * ELITE / (ELITE - 1)
        return mean, jnp.sqrt(variance)

    @jax.jit
    def begin(key):
        layer, place = jax.random.split(key)
        shape = (POPULATION, flat.size)
        numbers = jnp.broadcast_to(jnp.arange(POPULATION, dtype=flat.dtype)[:, None], shape)
        shuffled = jax.random.permutation(layer, numbers, independent=True)
        even = (shuffled + jax.random.uniform(place, shape, flat.dtype)) / POPULATION
        points = flat.low + (flat.high - flat.low) * even
        return fit(points, (flat.low + flat.high) / 2)

    @jax.jit
    def generation(key, mean, spread):
        z = jax.random.normal(key, (POPULATION, flat.size), flat.dtype)
        new = fit(flat.clip(mean + spread * z), mean)
        blend = lambda old, new: (1 - SHARE) * old + SHARE * new
        return jax.tree.map(blend, (mean, spread), new)

    def solve(y0, key, record):
        mean, spread = begin(jax.random.fold_in(key, 0))
        for i in itertools.count(1):
            record(flat.tree(mean))
            mean, spread = generation(jax.random.fold_in(key, i), mean, spread)

    return solve
