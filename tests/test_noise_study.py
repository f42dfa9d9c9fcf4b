"""The study of functions with noise: their means in closed form, and where these are lowest."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.studies import noise


@pytest.mark.parametrize(
    ("fun", "mean", "y"),
    [
        (noise.decay, lambda y: noise.expected(y) - noise.expected(noise.RATE), [0.5, 1.2]),
        (noise.newsvendor, noise.expected_cost, [14.0, 18.0, 2.0]),
    ],
)
def test_the_means_are_those_of_the_functions(fun, mean, y):
    y, keys = jnp.array(y), jax.random.split(jax.random.key(0), 4096)
    values = np.asarray(jax.jit(jax.vmap(lambda key: fun(y, None, key)))(keys))
    error = values.std(axis=0) / np.sqrt(len(keys))
    off = np.abs(values.mean(axis=0) - np.asarray(jax.jit(mean)(y)))
    assert np.all(off < 4 * error + 1e-6)


def test_the_newsvendor_is_best_where_it_costs_least():
    slope = jax.jit(jax.grad(noise.expected_cost))(noise.BEST)
    np.testing.assert_allclose(slope, 0, atol=1e-5)
    hessian = jax.jit(jax.hessian(noise.expected_cost))(noise.BEST)
    assert np.all(np.linalg.eigvalsh(hessian) > 0)
