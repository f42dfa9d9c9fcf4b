"""Control variates: unbiased whatever the surrogate is, better where it is good, bad input."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from closed_forms import polynomial

import smoothdiff as sd
from smoothdiff.surrogates import MLP

KEY = jax.random.key(4)
CASE = polynomial(3)
THETA, SIGMA = (np.array(v) for v in (CASE.theta, CASE.sigma))
QUICK: Any = {"num_samples": 256}
FEW: dict[str, Any] = {"num_samples": 16, "surrogate_options": QUICK}


def near(x):
    """The polynomial but for a wave: what a surrogate would have learnt."""
    return CASE.fun(x) + 0.3 * jnp.sin(3 * jnp.sum(x))


def far(x):
    """Nothing like the polynomial, and not differentiable."""
    return jnp.sum(jnp.abs(x)) + jnp.prod(x)


def hvp_along(v):
    def transform(fun, sigma, **options):
        g = sd.smooth_hvp(fun, sigma, **options)
        return lambda key, x: g(key, x, jnp.asarray(v, x.dtype))

    return transform


SMOOTHED = lambda x: CASE.smoothed(x, jnp.asarray(SIGMA, x.dtype))
VECTOR = np.array([0.5, -1.0, 2.0])
TRANSFORMS = {
    "value": (sd.smooth, SMOOTHED),
    "gradient": (sd.smooth_grad, jax.grad(SMOOTHED)),
    "Hessian": (sd.smooth_hessian, jax.hessian(SMOOTHED)),
    "product": (
        hvp_along(VECTOR),
        lambda x: jax.hessian(SMOOTHED)(x) @ jnp.asarray(VECTOR, x.dtype),
    ),
}


@pytest.mark.parametrize("what", TRANSFORMS)
@pytest.mark.parametrize("surrogate", [near, far])
def test_it_is_unbiased_whatever_the_surrogate_is(what, surrogate, dtype):
    transform, exact = TRANSFORMS[what]
    theta, sigma = jnp.asarray(THETA, dtype), jnp.asarray(SIGMA, dtype)
    g = sd.control_variate(
        transform, CASE.fun, surrogate, sigma, sampler=sd.Gaussian(), baseline="mean", **FEW
    )
    estimates = jax.jit(jax.vmap(lambda key: g(key, theta)))(jax.random.split(KEY, 2000))
    off = np.mean(estimates, axis=0) - exact(theta)
    stderr = np.std(estimates, axis=0) / np.sqrt(len(estimates))
    assert np.all(np.abs(off) < 4.5 * stderr)
    assert estimates.dtype == dtype


@pytest.mark.parametrize("what", TRANSFORMS)
def test_a_good_surrogate_lowers_the_variance(what):
    transform, _ = TRANSFORMS[what]
    theta, sigma = jnp.asarray(THETA, jnp.float32), jnp.asarray(SIGMA, jnp.float32)
    plain: dict[str, Any] = {"num_samples": 16, "sampler": sd.Gaussian(), "baseline": "mean"}
    fine: Any = {"num_samples": 1024}
    alone = transform(CASE.fun, sigma, **plain)
    helped = sd.control_variate(transform, CASE.fun, near, sigma, surrogate_options=fine, **plain)
    keys = jax.random.split(KEY, 300)
    spread = [
        np.std(jax.jit(jax.vmap(lambda k, g=g: g(k, theta)))(keys), 0) for g in (alone, helped)
    ]
    assert np.sum(spread[1] ** 2) < 0.2 * np.sum(spread[0] ** 2)


def test_a_quadratic_is_exact_from_a_few_evaluations():
    quadratic = lambda x: 1 + x[0] * x[1] + jnp.sum(x**2)
    x = jnp.array([0.3, -0.5, 0.1])
    exact: Any = {"baseline": "quadratic", "num_samples": 512}
    g = sd.control_variate(
        sd.smooth_hessian, quadratic, quadratic, 0.5, num_samples=8, surrogate_options=exact
    )
    np.testing.assert_allclose(g(KEY, x), jax.hessian(quadratic)(x), atol=2e-4)


def test_pytrees_other_arguments_and_errors():
    fun = lambda y, scale: scale * (jnp.floor(4 * y["a"]) + jnp.sum(y["b"] ** 2))
    surrogate = lambda y, scale: scale * (4 * y["a"] + jnp.sum(y["b"] ** 2))
    y = {"a": jnp.float32(0.4), "b": jnp.ones(2)}
    g = sd.control_variate(
        sd.smooth_grad, fun, surrogate, 0.3, num_samples=64, stderr=True, surrogate_options=QUICK
    )
    grad, stderr = jax.jit(g)(KEY, y, jnp.float32(2.0))
    jax.tree.map(lambda a, b, c: np.testing.assert_equal(a.shape, b.shape), grad, stderr, y)
    np.testing.assert_allclose(grad["b"], [4.0, 4.0], atol=4 * float(jnp.max(stderr["b"])))
    values, grads = sd.control_variate(
        sd.smooth_value_and_grad, fun, surrogate, 0.3, surrogate_options=QUICK
    )(KEY, y, jnp.float32(2.0))
    assert jax.tree.structure(grads) == jax.tree.structure(y)
    assert values.shape == ()


def test_it_can_be_differentiated_like_the_transform():
    g = sd.control_variate(sd.smooth, CASE.fun, near, 0.5, surrogate_options=QUICK)
    theta = jnp.asarray(THETA, jnp.float32)
    direct = sd.control_variate(sd.smooth_grad, CASE.fun, near, 0.5, surrogate_options=QUICK)
    np.testing.assert_allclose(jax.grad(g, 1)(KEY, theta), direct(KEY, theta), rtol=1e-4)


def test_what_zerograds_has_learnt_lowers_the_variance():
    plateaus = lambda y, args: jnp.sum(jnp.floor(16 * (y - 0.3) ** 2)) / 16
    small = functools.partial(MLP, width=32, depth=2)
    solver = sd.ZeroGrads(0.3, surrogate=small, num_samples=4)
    y0 = jnp.array([-0.5, 0.8, 0.1])
    solution = optx.minimise(plateaus, solver, y0, options={"key": KEY}, max_steps=400, throw=False)
    learnt = solver.learnt(solution.state, solution.value)
    fun = functools.partial(plateaus, args=None)
    options: dict[str, Any] = {"num_samples": 8, "sampler": sd.Gaussian(), "baseline": "mean"}
    transforms = (
        sd.smooth_grad(fun, 0.3, **options),
        sd.control_variate(sd.smooth_grad, fun, learnt, 0.3, **options),
    )
    keys, y = jax.random.split(KEY, 200), solution.value
    spread = [np.std(jax.jit(jax.vmap(lambda k, g=g: g(k, y)))(keys), 0) for g in transforms]
    assert np.sum(spread[1] ** 2) < 0.5 * np.sum(spread[0] ** 2)


def test_bad_input():
    with pytest.raises(ValueError, match="aux"):
        sd.control_variate(sd.smooth, near, near, 0.1, has_aux=True)
    with pytest.raises(TypeError, match="one random key"):
        sd.control_variate(sd.smooth, near, near, 0.1)(jnp.ones(3))  # pyright: ignore
