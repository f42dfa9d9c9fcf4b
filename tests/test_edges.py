"""Where the lowest point lies at an edge, beyond which the function has no value."""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import NonlinearConstraint, minimize

import smoothdiff as sd

# by name: the normal of the edge and how far away it is
EDGES = {"along an axis": ((1.0, 0.0), 0.5), "oblique": ((1.0, -0.5), 1.2)}
LOWEST = np.array([1.0, -2.0])


def bowl(y, edge):
    normal, away = edge
    return jnp.where(jnp.dot(y, normal) > away, jnp.nan, jnp.sum((y - LOWEST) ** 2))


def decay(y, most):
    times = jnp.linspace(0.0, 3.0, 12)
    rows = y[1] * jnp.exp(-y[0] * times) - 2 * jnp.exp(-1.5 * times)
    return jnp.where(y[0] > most, jnp.nan, rows)


def lowest_of_decay(most):
    """By SciPy, where it is finite."""
    fun = lambda y: float(np.sum(np.asarray(decay(jnp.asarray(y), 9.0), float) ** 2)) / 2
    edge = NonlinearConstraint(lambda y: y[0], -np.inf, most)
    return minimize(fun, [0.3, 0.5], method="COBYLA", constraints=[edge], tol=1e-6).fun


@pytest.mark.parametrize("name", list(EDGES))
def test_a_number_is_lowest_at_an_edge(name):
    """Steps that fail say which way is open, so it gets there and does not stop where it came."""
    edge = jnp.array(EDGES[name][0]), jnp.float32(EDGES[name][1])
    normal, away = (np.asarray(part, float) for part in edge)
    least = (normal @ LOWEST - away) ** 2 / (normal @ normal)
    gaps = []
    for seed in range(5):
        y0 = jnp.full(2, 0.01 * seed)
        found = sd.minimise(bowl, y0, edge, key=jax.random.key(seed), max_evaluations=120)
        gaps.append((found.fun - least) / (np.sum(LOWEST**2) - least))
    assert np.median(gaps) < 0.002
    assert sorted(gaps)[-2] < 0.02


def test_residuals_are_lowest_at_an_edge():
    most = jnp.float32(1.2)
    least = lowest_of_decay(1.2)
    start = jnp.array([0.3, 0.5])
    first = float(jnp.sum(decay(start, 9.0) ** 2)) / 2
    gaps = []
    for seed in range(5):
        y0, key = start + 0.01 * seed, jax.random.key(seed)
        found = sd.least_squares(decay, y0, most, key=key, max_evaluations=60)
        gaps.append((found.fun - least) / (first - least))
    assert np.median(gaps) < 0.005
    assert max(gaps) < 0.02


def test_errors_of_parameters_are_of_evaluations_alone(x64):
    """What is guessed beyond an edge is for the model."""

    def fall(y, args):
        most, seen = args
        times = jnp.linspace(0.0, 3.0, 24)
        rows = y[0] * jnp.exp(-y[1] * times) + y[2] - seen
        return jnp.where(y[1] + 0.3 * y[2] > most, jnp.nan, rows)

    known, guessed = 0, 0
    for seed in range(4):
        noise = 0.05 * jax.random.normal(jax.random.key(seed), (24,))
        seen = fall(jnp.array([2.0, 1.0, 0.5]), (9.0, -noise))
        y0, key = jnp.array([1.0, 0.3, 0.1]), jax.random.key(seed)
        result: Any = sd.least_squares(fall, y0, (1.1, seen), key=key, max_evaluations=200)
        history = result.state.search.history
        guessed += int(np.sum(history.guessed))
        slopes = np.asarray(jax.jacobian(fall)(result.y, (9.0, seen)))
        expected = 2 * result.fun / 21 * np.linalg.inv(slopes.T @ slopes)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # some may not be known
            found = np.asarray(result.parameter_errors)
        if np.all(np.isfinite(found)):
            known += 1
            np.testing.assert_allclose(found, np.sqrt(np.diag(expected)), rtol=0.1)
    assert known >= 2
    assert guessed > 0
