"""Every sampler with every baseline that claims it is unbiased, from two samples to 64.

And those that do not claim it are biased by as much as they say.
"""

import functools
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import (
    Several,
    assert_unbiased,
    half_space,
    keys,
    quadratic_model,
    smoothed_half_space,
)
from parts import new_ones

import smoothdiff as sd

THETA, SIGMA = jnp.array([0.3, -0.2]), jnp.array([0.5, 0.8])


def cubic_and_step(x):
    return x[0] ** 3 + (x[0] + x[1] > 0).astype(x.dtype)


def smoothed(theta, sigma):
    cubic = theta[0] ** 3 + 3 * theta[0] * sigma[0] ** 2
    return cubic + jax.scipy.stats.norm.cdf(jnp.sum(theta) / jnp.sqrt(jnp.sum(sigma**2)))


def derivatives(g):
    """Value, derivatives in theta and sigma, and the Hessian of g, in forward mode."""

    def joint(theta, sigma):
        def first(theta):
            # with the value along, two evaluations do for everything
            slope, value = jax.jacfwd(lambda t: (value := g(t, sigma), value), has_aux=True)(theta)
            return slope, (value, slope)

        hessian, (value, slope) = jax.jacfwd(first, has_aux=True)(theta)
        return value, slope, jax.jacfwd(g, argnums=1)(theta, sigma), hessian

    return joint


def estimates(names, *, num_keys, **options):
    """The derivatives for each baseline of `names`, and for each key."""

    def for_key(key):
        g = lambda theta, sigma: sd.smooth(
            cubic_and_step, sigma, baseline=Several(*names), **options
        )(key, theta)
        found = derivatives(g)(THETA, SIGMA)
        return {name: tuple(part[name] for part in found) for name in names}

    # key after key: batches of small factorisations in one program have been seen to hang
    return jax.jit(lambda keys: jax.lax.map(for_key, keys))(keys(num_keys))


SAMPLERS = {
    "gaussian": sd.Gaussian(),
    "pairs": sd.Gaussian(antithetic=True),
    "frames": sd.Orthogonal(antithetic=False),
    "frames of pairs": sd.Orthogonal(),
    "sobol": sd.Sobol(),
    "replicates": sd.Sobol(replicates=2),
    "aggregate 1": sd.Aggregate(1),
    "aggregate 2, quasi": sd.Aggregate(2, antithetic=False, quasi=True),
}
# a new one, with its defaults; Uniform is biased, as it says
NEW = new_ones(sd.AbstractSampler, [sd.Uniform, *map(type, SAMPLERS.values())])
FITS = ("linear", "quadratic", "gp")
# how many keys for so many samples, and the standard errors that they must reach
PRECISION = {
    2: (4096, 0.15),
    4: (4096, 0.12),
    8: (2048, 0.12),
    24: (1024, 0.1),
    64: (1024, 0.06),
}
# 24 are enough for a full quadratic fit of pairs; two are one group of pairs, of frames
QUICK = [(name, 24) for name in [*list(SAMPLERS)[::5], *NEW]]
QUICK += [("aggregate 2, quasi", 2)]
SAMPLERS |= NEW
# one set that is even as a whole is fitted as a whole, which is biased
WHOLE = [name for name, sampler in SAMPLERS.items() if sampler.group(64, 2) == 64]
FITTED = [
    case if case in QUICK else pytest.param(*case, marks=pytest.mark.slow)
    for case in itertools.product(SAMPLERS, PRECISION)
]


@functools.cache
def exact():
    return jax.jit(derivatives(smoothed))(THETA, SIGMA)


@pytest.mark.parametrize(("name", "num_samples"), FITTED)
def test_no_bias(name, num_samples):
    """One sample more is drawn, at the center, which is a baseline too."""
    names = ("none", "center") if name in WHOLE else ("none", "mean", "center", *FITS)
    num_keys, resolution = PRECISION[num_samples]
    options: dict[str, Any] = {"sampler": SAMPLERS[name], "num_samples": num_samples + 1}
    found = estimates(names, num_keys=num_keys, **options)
    for baseline in names:
        assert_unbiased(found[baseline], exact(), resolution=resolution, name=baseline)


@pytest.mark.parametrize("num_samples", [8, pytest.param(24, marks=pytest.mark.slow)])
def test_the_mean_of_one_weighted_set_is_biased(num_samples):
    """As `Aggregate` says: the gradient of a step by -8 % at N = 8, by -2 % at 24."""
    theta, sigma = jnp.array([0.3]), jnp.array([0.5])
    g = sd.smooth_grad(
        half_space,
        0.5,
        sampler=SAMPLERS["aggregate 2, quasi"],
        baseline="mean",
        num_samples=num_samples,
    )
    found = np.asarray(jax.jit(jax.vmap(g, (0, None)))(keys(20_000), theta), float)[:, 0]
    exact = float(jax.jit(jax.grad(smoothed_half_space))(theta, sigma)[0])
    error = np.std(found) / np.sqrt(20_000) / exact
    assert error < 0.003
    bias = np.mean(found) / exact - 1
    assert abs(bias - {8: -0.084, 24: -0.024}[num_samples]) < 4.5 * error


@pytest.mark.parametrize(("sampler", "num_samples"), [(sd.Sobol(), 1), (sd.Sobol(True), 2)])
def test_a_lone_point_loses_nothing_to_a_mean(sampler, num_samples, key):
    """Less its own mean it would be zero, and with it the gradient, or the Hessian of a pair."""
    options: dict[str, Any] = {"sampler": sampler, "num_samples": num_samples}
    models = [
        quadratic_model(cubic_and_step, SIGMA, baseline=b, **options) for b in ("mean", "none")
    ]
    for mean, none in zip(*jax.jit(lambda: [g(key, THETA) for g in models])(), strict=True):
        np.testing.assert_array_equal(mean, none)
        assert np.all(mean != 0)


@pytest.mark.parametrize(
    ("num_samples", "bias"),
    [(2, -0.18), *(pytest.param(*case, marks=pytest.mark.slow) for case in [(3, -0.14), (8, 0)])],
)
def test_the_mean_of_a_small_set_is_biased_as_it_says(num_samples, bias):
    g = sd.smooth_grad(jnp.sum, 1.0, baseline="mean", num_samples=num_samples)
    found = np.asarray(jax.jit(jax.vmap(g, (0, None)))(keys(20_000), jnp.zeros(())), float)
    error = np.std(found) / np.sqrt(20_000)
    assert error < 0.01
    assert abs(np.mean(found) - 1 - bias) < 4.5 * error + 0.005
