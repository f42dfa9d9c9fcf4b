"""Finding by probes which term depends on which parameter: what is missed, and how often."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import keys

import smoothdiff as sd

KEY = jax.random.key(0)


def steps(x):
    return (x > 0).astype(x.dtype)


def matrix_of(support, n):
    return np.asarray(jax.jacfwd(support)(jnp.zeros(n)))


@pytest.mark.slow
def test_probing_finds_a_known_structure():
    """Over 8 keys: at most the promised share is missed, and most of the rest is ruled out."""
    rng = np.random.default_rng(1)
    n, num_terms, reach = 40, 30, 3
    truth = np.zeros((num_terms, n), bool)
    for row in truth:
        row[rng.choice(n, reach, replace=False)] = True
    weights = jnp.asarray(truth * rng.uniform(1, 2, truth.shape), jnp.float32)
    calls: list[int] = []

    def host(total):
        calls.append(total.size // num_terms)
        return np.round(4 * np.asarray(total))

    def fun(x):
        # rounding: moving a parameter moves its terms with a probability of more than a half
        total = jnp.matmul(weights, x, precision="highest")
        return jax.pure_callback(
            host,
            jax.ShapeDtypeStruct((num_terms,), jnp.float32),
            total,
            vmap_method="expand_dims",
        )

    probe = sd.probe_support(fun, 1.0, num_samples=300, reach=reach, confidence=0.99)
    missed, extra = [], []
    for key in keys(8):
        calls.clear()
        support = probe(key, jnp.zeros(n))
        assert sum(calls) == 300
        found = matrix_of(support, n) > 0
        missed.append(np.mean(truth & ~found) / np.mean(truth))
        extra.append(np.mean(found & ~truth))
    assert np.mean(missed) <= 0.01
    assert np.mean(extra) < 0.05
    # and what it finds is a support
    support = probe(KEY, jnp.zeros(n))
    g = sd.smooth_grad(fun, 1.0, support=support, num_samples=8, baseline="mean")
    assert g(KEY, jnp.zeros(n)).shape == (n,)


@pytest.mark.slow
def test_confidence_is_how_often_an_influence_is_kept():
    """Where an influence is as rare as `response` allows, it is missed as often as stated."""
    # a step moves with probability one half exactly
    for confidence, low, high in ((0.9, 0.06, 0.13), (0.99, 0.004, 0.02)):
        probe = sd.probe_support(
            steps, 1.0, num_samples=200, reach=1, response=0.5, confidence=confidence
        )
        missed = [
            1 - np.mean(np.diagonal(matrix_of(probe(key, jnp.zeros(200)), 200))) for key in keys(10)
        ]
        assert low <= np.mean(missed) <= high, (confidence, missed)


def test_a_term_that_hardly_moves_stands_still():
    fun = lambda x: jnp.stack([x[0] + 1e-3 * x[1], x[1]])
    probe = sd.probe_support(fun, 1.0, num_samples=100, reach=1, atol=0.01)
    np.testing.assert_array_equal(matrix_of(probe(KEY, jnp.zeros(2)), 2), np.eye(2))


def test_numbers_out_of_range():
    for bad in ({"response": 0.0}, {"confidence": 1.0}, {"reach": 0}, {"atol": -1.0}):
        options: dict[str, Any] = {"num_samples": 100, "reach": 1, **bad}
        with pytest.raises(ValueError, match="probe_support takes"):
            sd.probe_support(steps, 1.0, **options)
    with pytest.raises(ValueError, match="about 300 are good"):
        sd.probe_support(steps, 1.0, num_samples=1, reach=3)


def test_a_change_to_nan_and_of_a_switch_is_one():
    everywhere = [0, 1, 2, 3, 4]
    for terms in (lambda x: jnp.where(abs(x) > 0.1, jnp.nan, 0.0), lambda x: abs(x) > 0.1):
        support = sd.probe_support(terms, 1.0, num_samples=100, reach=1)(
            jax.random.key(0), jnp.zeros(5)
        )
        assert sorted(support.params.tolist()) == everywhere
    # unsigned numbers do not wrap around
    counts = lambda x: (10 + jnp.sign(x)).astype(jnp.uint8)
    still = sd.probe_support(counts, 1.0, num_samples=100, reach=1, atol=1.5)
    assert still(jax.random.key(0), jnp.zeros(5)).params.tolist() == []
    # what is NaN before and after stands still
    hole = lambda x: jnp.where(jnp.arange(5) == 2, jnp.nan, jnp.round(4 * x))
    probe = sd.probe_support(hole, 1.0, num_samples=100, reach=1)
    assert sorted(probe(jax.random.key(0), jnp.zeros(5)).params.tolist()) == [0, 1, 3, 4]
