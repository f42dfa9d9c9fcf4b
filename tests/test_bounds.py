"""Where the function is called: clamped to bounds; and what happens to samples that are bad."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import PLAIN, assert_same, assert_unbiased, boxes, keys
from jax.scipy.stats import norm

import smoothdiff as sd

PAIRS = sd.Gaussian(antithetic=True)


def test_the_function_sees_clamped_points_and_the_weights_do_not():
    """f(x) = x below the bound 0.2 sigma away: slope Phi(0.2) = 0.579; clamped weights: 0.518."""
    g = sd.smooth_value_and_grad(
        lambda x: (x, x), 1.0, **PLAIN, bounds=(-0.2, np.inf), has_aux=True
    )
    (value, points), grad = jax.jit(jax.vmap(g, in_axes=(0, None)))(keys(8192), jnp.array(0.0))
    assert jnp.min(points) == jnp.float32(-0.2)
    assert float(jnp.mean(points == jnp.min(points))) == pytest.approx(0.4207, abs=0.01)
    exact = (norm.pdf(0.2) - 0.2 * norm.cdf(-0.2), norm.cdf(0.2))
    assert float(exact[1]) == pytest.approx(0.579, abs=5e-4)
    assert_unbiased((value, grad), exact, resolution=0.005)


@pytest.mark.slow
def test_smoothing_of_the_clamped_function(key):
    """Value, gradient, Hessian of E clip(x) between two bounds, in one leaf of a pytree."""

    def clipped(theta, low=-0.5, high=1.0, sigma=0.6):
        u, v = (low - theta) / sigma, (high - theta) / sigma
        inside = theta * (norm.cdf(v) - norm.cdf(u)) + sigma * (norm.pdf(u) - norm.pdf(v))
        return low * norm.cdf(u) + high * norm.cdf(-v) + inside

    fun = lambda p: p["a"] + jnp.where(p["b"] > 0, 1.0, 0.0)
    smoothed = lambda p: clipped(p["a"]) + norm.cdf(p["b"] / 0.6)
    p = {"a": jnp.array(0.1), "b": jnp.array(0.2)}
    bounds = ({"a": -0.5, "b": None}, {"a": jnp.array(1.0), "b": None})

    def first_two(k):
        g = sd.smooth(fun, 0.6, bounds=bounds, **PLAIN, num_samples=512)
        return jax.grad(g, 1)(k, p), jax.hessian(g, 1)(k, p)

    found = jax.jit(jax.vmap(first_two))(keys(2048))
    exact = jax.grad(smoothed)(p), jax.hessian(smoothed)(p)
    pack = lambda tree, axis: jnp.stack(jax.tree.leaves(tree), axis)
    for estimate, want in zip(found, exact, strict=True):
        assert_unbiased(pack(estimate, 1), pack(want, 0), resolution=0.03)


def test_the_center_is_clamped_too_and_a_parameter_may_lie_on_its_bound(key):
    options: dict[str, Any] = {"sampler": PAIRS, "baseline": "center", "num_samples": 3}
    g = sd.smooth(lambda x: x, 1.0, **options, bounds=(0.0, 1.0))
    run = jax.jit(lambda x: g(key, x))
    assert jnp.isfinite(run(0.0))
    assert jnp.isfinite(run(1.0))


# ---------------------------------------------------------------------------------------------
# samples that are not finite


def test_dropped_samples_give_the_reweighted_expectation():
    """f = x, NaN above the 90 % quantile q: E[x | x < q], with slope Var[x | x < q] / sigma^2."""
    q = 1.2815516
    fun = lambda x: jnp.where(x < 0.3 + 0.5 * q, x, jnp.nan)
    g = sd.smooth_value_and_grad(fun, 0.5, **PLAIN, num_samples=4096, nonfinite="drop")
    found = jax.jit(jax.vmap(g, in_axes=(0, None)))(keys(256), jnp.array(0.3))
    mean = -norm.pdf(q) / 0.9
    exact = 0.3 + 0.5 * mean, 1 - q * norm.pdf(q) / 0.9 - mean**2
    assert_unbiased(found, exact, resolution=0.003)


@pytest.mark.parametrize(("antithetic", "bad"), [(False, np.nan), (True, np.inf)])
def test_dropped_samples_by_hand(antithetic, bad, key, x64):
    def fun(x):
        return jnp.where(x[0] > 1.0, bad, boxes(x) + x[1] ** 3), x

    theta = jnp.array([0.3, -0.2])
    options: dict[str, Any] = {
        "num_samples": 24,
        "baseline": "mean",
        "nonfinite": "drop",
        "has_aux": True,
        "sampler": sd.Gaussian(antithetic=antithetic),
    }
    both = jax.jit(sd.smooth_value_and_grad(fun, 0.5, **options))
    (value, points), grad = both(key, theta)
    f = np.asarray(jax.vmap(fun)(points)[0])
    kept = np.isfinite(f)
    assert 12 <= kept.sum() < 24
    group = np.arange(24) // (2 if antithetic else 1)
    b = np.array([f[kept & (group != i)].mean() for i in group])
    z = (np.asarray(points) - np.asarray(theta)) / 0.5
    by_hand = ((f - b)[:, None] * z)[kept].mean(axis=0) / 0.5
    np.testing.assert_allclose(value, f[kept].mean(), rtol=1e-12)
    np.testing.assert_allclose(grad, by_hand, rtol=1e-11)
    with_errors = jax.jit(sd.smooth_value_and_grad(fun, 0.5, **options, stderr=True))
    _, (value_error, error) = with_errors(key, theta)
    assert float(value_error) > 0
    assert np.all(np.asarray(error) > 0)


def every_estimate(fun, key, x, **options):
    model = sd.smooth_quadratic(fun, 0.5, **options)(key, x)
    return (
        sd.smooth_value_and_grad(fun, 0.5, **options)(key, x),
        sd.smooth_hessian(fun, 0.5, **options)(key, x),
        (model.value, model.grad, model.hessian.mv(x), model.stderr, model.hessian_stderr(x)),
    )


def all_leaves(predicate, tree) -> bool:
    return all(bool(jnp.all(predicate(leaf))) for leaf in jax.tree.leaves(tree))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_too_few_finite_samples_and_propagation_give_nan(bad, key):
    """Every sample whose first number is at most the threshold is bad."""
    x = jnp.array([0.1, 0.2])
    draw = lambda x: (jnp.float32(0), x)
    g = sd.smooth(draw, 0.5, **PLAIN, num_samples=8, has_aux=True)
    rows = jax.jit(g)(key, x)[1]
    order = jnp.sort(rows[:, 0])

    @jax.jit
    def run(threshold, x):
        fun = lambda x: jnp.where(x[0] > threshold, jnp.round(jnp.sum(x)), bad)
        options: dict[str, Any] = {**PLAIN, "num_samples": 8}
        drop = every_estimate(fun, key, x, **options, nonfinite="drop")
        return drop, every_estimate(fun, key, x, **options)

    drop, propagate = run(order[3], x)  # exactly half are left
    assert all_leaves(jnp.isfinite, drop)
    assert all_leaves(lambda leaf: ~jnp.isfinite(leaf), propagate)
    drop, _ = run(order[4], x)  # fewer
    assert all_leaves(jnp.isnan, drop)
    drop, propagate = run(order[0] - 1, x)  # none bad: both are the plain estimate
    assert_same(drop, propagate)


def test_half_left_is_enough_when_it_is_one_pair(key):
    """The others of the only pair left are all dropped: there is no mean of them to subtract."""
    x = jnp.zeros(1)
    options: dict[str, Any] = {"num_samples": 4, "sampler": PAIRS, "baseline": "mean"}
    draw = sd.smooth(lambda x: (x[0], x[0]), 0.5, has_aux=True, **options)
    points = jax.jit(draw)(key, x)[1]
    limit = (jnp.abs(points[0]) + jnp.abs(points[2])) / 2
    fun = lambda x: jnp.where(jnp.abs(x[0]) < limit, x[0] + 3, jnp.nan)
    drop = jax.jit(sd.smooth_value_and_grad(fun, 0.5, nonfinite="drop", **options))
    value, grad = drop(key, x)
    assert float(value) == pytest.approx(3.0)
    z2 = float(jnp.min(jnp.abs(points)) / 0.5) ** 2
    assert float(grad[0]) == pytest.approx(z2, rel=1e-5)
    hessian = jax.jit(sd.smooth_hessian(fun, 0.5, nonfinite="drop", **options))(key, x)
    assert float(hessian[0, 0]) == pytest.approx(3 * (z2 - 1) / 0.25, rel=1e-5)


def test_a_sample_with_one_bad_pixel_is_dropped_whole(key):
    image = lambda x: {"a": jnp.array([1.0, 2.0]), "b": jnp.where(x > 0, jnp.nan, 1.0)}
    options: dict[str, Any] = {"sampler": PAIRS, "baseline": "mean", "num_samples": 16}
    g = sd.smooth(image, 0.5, **options, nonfinite="drop")
    out = jax.jit(g)(key, 0.0)
    assert_same(out, {"a": jnp.array([1.0, 2.0]), "b": jnp.array(1.0)})
