"""Control variates: unbiased whatever the surrogate is, better where it is good, bad input."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest
from closed_forms import assert_same, polynomial, quadratic_model

import smoothdiff as sd
from smoothdiff.surrogates import MLP

KEY = jax.random.key(4)
CASE = polynomial(3)
THETA, SIGMA = (np.array(v) for v in (CASE.theta, CASE.sigma))
VECTOR = np.array([0.5, -1.0, 2.0])
QUICK: Any = {"num_samples": 256}
PLAIN: dict[str, Any] = {"num_samples": 16, "sampler": sd.Gaussian(), "baseline": "mean"}
FEW: dict[str, Any] = {**PLAIN, "surrogate_options": QUICK}


def near(x):
    """The polynomial but for a wave: what a surrogate would have learnt."""
    return CASE.fun(x) + 0.3 * jnp.sin(3 * jnp.sum(x))


def far(x):
    """Nothing like the polynomial, and not differentiable."""
    return jnp.sum(jnp.abs(x)) + jnp.prod(x)


def fun(x, is_near):
    return CASE.fun(x)


def surrogate(x, is_near):
    return jax.lax.select(is_near, near(x), far(x))


def hvp(fun, sigma, **options):
    """The Hessian's product with the vector, for a key and parameters."""
    g = sd.smooth_hvp(fun, sigma, **options)
    return lambda key, x, *args: g(key, x, *args, jnp.asarray(VECTOR, x.dtype))


def all_of_them(fun, sigma, **options):
    """Value, gradient, Hessian and its product with a vector, from one batch."""

    def g(key, x, *args):
        model = quadratic_model(lambda x: fun(x, *args), sigma, **options)
        value, grad, hessian = model(key, x)
        return value, grad, hessian, hessian @ jnp.asarray(VECTOR, x.dtype)

    return g


NAMES = ("value", "gradient", "Hessian", "product")


@pytest.fixture(scope="module")
def found():
    """For each dtype: exact ones, and estimates without and with surrogates, near and far."""

    @functools.cache
    def of(dtype):
        theta, sigma = jnp.asarray(THETA, dtype), jnp.asarray(SIGMA, dtype)
        g = sd.control_variate(all_of_them, fun, surrogate, sigma, **FEW)
        alone = all_of_them(fun, sigma, **PLAIN)

        @jax.jit
        def estimates(keys):
            of_all = jax.vmap(lambda key: alone(key, theta, True))
            of_both = jax.vmap(lambda key, is_near: g(key, theta, is_near), (0, None))
            both = jax.vmap(of_both, (None, 0))(keys, jnp.array([True, False]))
            near, far = zip(*both, strict=True)
            return of_all(keys), near, far

        @jax.jit
        def exact():
            smoothed = lambda x: CASE.smoothed(x, sigma)
            hessian = jax.hessian(smoothed)(theta)
            value, grad = jax.value_and_grad(smoothed)(theta)
            return value, grad, hessian, hessian @ jnp.asarray(VECTOR, dtype)

        return exact(), *estimates(jax.random.split(KEY, 2000))

    return of


@pytest.mark.slow
@pytest.mark.parametrize(
    "dtype", ["float32", pytest.param("float64", marks=pytest.mark.slow)], indirect=True
)
def test_it_is_unbiased_whatever_the_surrogate_is(found, dtype):
    exact, _, near, far = found(dtype)
    for which, estimates in {"near": near, "far": far}.items():
        for name, many, one in zip(NAMES, estimates, exact, strict=True):
            off = np.mean(many, axis=0) - one
            stderr = np.std(many, axis=0) / np.sqrt(len(many))
            assert np.all(np.abs(off) < 4.5 * stderr), (which, name)
            assert many.dtype == dtype


@pytest.mark.slow
def test_a_good_surrogate_lowers_the_variance(found):
    _, alone, helped, _ = found(np.dtype("float32"))
    for name, *both in zip(NAMES, alone, helped, strict=True):
        before, after = (np.sum(np.var(estimates, axis=0)) for estimates in both)
        assert after < 0.2 * before, name


@pytest.mark.slow
def test_each_transform_is_a_part_of_it(x64):
    theta, sigma = jnp.asarray(THETA), jnp.asarray(SIGMA)
    transforms = {
        "value": sd.smooth,
        "gradient": sd.smooth_grad,
        "both": sd.smooth_value_and_grad,
        "jacobian": sd.smooth_jacobian,
        "Hessian": sd.smooth_hessian,
        "product": hvp,
        "all": all_of_them,
    }

    @jax.jit
    def estimates(key):
        of = lambda transform: sd.control_variate(transform, CASE.fun, near, sigma, **FEW)
        return {name: of(transform)(key, theta) for name, transform in transforms.items()}

    parts = estimates(KEY)
    value, grad, hessian, product = parts.pop("all")
    wanted = {
        "value": value,
        "gradient": grad,
        "both": (value, grad),
        "jacobian": grad,
        "Hessian": hessian,
        "product": product,
    }
    for name, part in parts.items():
        assert_same(part, wanted[name], np.float64, scale=10)
        assert {leaf.dtype for leaf in jax.tree.leaves(part)} == {np.dtype(float)}


def test_a_quadratic_is_exact_from_a_few_evaluations():
    quadratic = lambda x: 1 + x[0] * x[1] + jnp.sum(x**2)
    x = jnp.array([0.3, -0.5, 0.1])
    exact: Any = {"baseline": "quadratic", "num_samples": 512}
    g = sd.control_variate(
        sd.smooth_hessian, quadratic, quadratic, 0.5, num_samples=8, surrogate_options=exact
    )
    np.testing.assert_allclose(jax.jit(g)(KEY, x), [[2, 1, 0], [1, 2, 0], [0, 0, 2]], atol=2e-4)


def test_pytrees_other_arguments_and_errors():
    fun = lambda y, scale: scale * (jnp.floor(4 * y["a"]) + jnp.sum(y["b"] ** 2))
    surrogate = lambda y, scale: scale * (4 * y["a"] + jnp.sum(y["b"] ** 2))
    y = {"a": jnp.float32(0.4), "b": jnp.ones(2)}
    g = sd.control_variate(
        sd.smooth_value_and_grad,
        fun,
        surrogate,
        0.3,
        num_samples=64,
        stderr=True,
        surrogate_options=QUICK,
    )
    (value, grad), (value_error, error) = jax.jit(g)(KEY, y, jnp.float32(2.0))
    assert value.shape == value_error.shape == ()
    assert (
        jax.tree.map(np.shape, grad) == jax.tree.map(np.shape, error) == jax.tree.map(np.shape, y)
    )
    np.testing.assert_allclose(grad["b"], [4.0, 4.0], atol=4 * float(np.max(error["b"])))


def test_both_parts_are_smoothed_by_the_same_noise():
    """Of a surrogate that is the function itself nothing is left but its own part."""
    fun, gumbel = lambda x: jnp.sum(jnp.maximum(x, 0)), optax.perturbations.Gumbel()
    g = sd.control_variate(sd.smooth, fun, fun, 0.5, noise=gumbel, num_samples=2)
    found = jax.jit(g)(KEY, jnp.ones(1))
    # far from the kink: E[1 + z / 2] with the mean of a Gumbel distribution, not of a normal one
    np.testing.assert_allclose(found, 1 + 0.5 * np.euler_gamma, atol=0.04)


def test_it_can_be_differentiated_like_the_transform():
    of = lambda transform: sd.control_variate(
        transform, CASE.fun, near, 0.5, surrogate_options=QUICK
    )
    theta = jnp.asarray(THETA, jnp.float32)
    both = jax.jit(
        lambda key: (jax.grad(of(sd.smooth), 1)(key, theta), of(sd.smooth_grad)(key, theta))
    )
    np.testing.assert_allclose(*both(KEY), rtol=1e-4)


def plateaus(y, args=None):
    return jnp.sum(jnp.floor(16 * (y - 0.3) ** 2)) / 16


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "steps"),
    [
        (
            {
                "surrogate": functools.partial(MLP, width=16, depth=1),
                "surrogate_optimizer": optax.adam(0.01),
                "replay": 20,
            },
            150,
        ),
        pytest.param(
            {"surrogate": functools.partial(MLP, width=32, depth=2)}, 400, marks=pytest.mark.slow
        ),
    ],
    ids=["quick", "careful"],
)
def test_what_zerograds_has_learnt_lowers_the_variance(settings, steps):
    solver = sd.ZeroGrads(0.3, num_samples=4, **settings)
    options: dict[str, Any] = {"num_samples": 8, "sampler": sd.Gaussian(), "baseline": "mean"}

    @jax.jit
    def spread(key):
        y0 = jnp.array([-0.5, 0.8, 0.1])
        run = functools.partial(optx.minimise, plateaus, solver, y0, options={"key": key})
        solution = run(max_steps=steps, throw=False)
        learnt, y = solver.learnt(solution.state, solution.value), solution.value
        alone = sd.smooth_grad(plateaus, 0.3, **options)
        helped = sd.control_variate(sd.smooth_grad, plateaus, learnt, 0.3, **options)
        grads = jax.vmap(lambda key: (alone(key, y), helped(key, y)))(jax.random.split(key, 200))
        return [jnp.sum(jnp.var(g, axis=0)) for g in grads]

    before, after = spread(KEY)
    assert after < 0.5 * before


def test_bad_input():
    with pytest.raises(ValueError, match="use smooth_value_and_grad"):
        sd.control_variate(sd.smooth_quadratic, near, near, 0.1)
    with pytest.raises(ValueError, match="aux"):
        sd.control_variate(sd.smooth, near, near, 0.1, has_aux=True)
    with pytest.raises(TypeError, match="one random key"):
        sd.control_variate(sd.smooth, near, near, 0.1)(jnp.ones(3))  # pyright: ignore
