"""The Gaussian's derivatives as densities: against numerical integration, AD and a KS test."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, optimize, stats

from smoothdiff import kernels

ORDERS = (0, 1, 2)
SIGMA = 0.7
FUNCTIONS = (kernels.derivative, kernels.log_density, kernels.cdf, kernels.inverse_cdf)
# eager mode would compile every operation by itself
derivative, log_density, cdf, inverse_cdf = (jax.jit(f, static_argnums=2) for f in FUNCTIONS)
# the normal density and its derivatives, with NumPy alone
EXACT = (
    lambda x: stats.norm.pdf(x, scale=SIGMA),
    lambda x: -x / SIGMA**2 * stats.norm.pdf(x, scale=SIGMA),
    lambda x: (x**2 / SIGMA**2 - 1) / SIGMA**2 * stats.norm.pdf(x, scale=SIGMA),
)


def density(order):
    """The magnitude of the derivative, normalised by numerical integration."""
    mass = integrated(order, -np.inf, np.inf)
    return lambda x: np.abs(EXACT[order](x)) / mass


def integrated(order, low, high):
    """The integral of the derivative's magnitude, in pieces without kinks."""
    edges = [-np.inf, -SIGMA, 0.0, SIGMA, np.inf]
    pieces = zip(np.clip(edges[:-1], low, high), np.clip(edges[1:], low, high), strict=True)
    return sum(
        integrate.quad(lambda x: abs(EXACT[order](x)), a, b, epsabs=1e-14)[0]
        for a, b in pieces
        if a < b
    )


def tail(t, order):
    """The probability beyond t >= 0 standard deviations, with SciPy alone."""
    if order == 0:
        return stats.norm.sf(t)
    if order == 1:
        return np.exp(-t * t / 2) / 2
    hump = t * np.exp((1 - t * t) / 2) / 4
    return hump if t > 1 else 0.5 - hump


@pytest.mark.parametrize("order", ORDERS)
def test_the_derivative_is_that_of_the_density(order, dtype):
    fun = lambda x: derivative(x, SIGMA, 0)
    for _ in range(order):
        fun = jax.grad(fun)
    x = jnp.linspace(-4, 4, 101, dtype=dtype)
    found = derivative(x, SIGMA, order)
    assert found.dtype == dtype
    np.testing.assert_allclose(found, jax.vmap(fun)(x), atol=200 * float(jnp.finfo(dtype).eps))
    np.testing.assert_allclose(found, EXACT[order](x), atol=200 * float(jnp.finfo(dtype).eps))


@pytest.mark.parametrize("order", ORDERS)
def test_the_density_is_the_normalised_magnitude(order, dtype):
    x = jnp.linspace(-5, 5, 101, dtype=dtype) + 0.003
    found = log_density(x, SIGMA, order)
    assert found.dtype == dtype
    np.testing.assert_allclose(
        np.exp(found), density(order)(np.asarray(x, float)), rtol=1000 * float(jnp.finfo(dtype).eps)
    )


@pytest.mark.parametrize("order", [1, 2])
def test_the_density_vanishes_where_the_derivative_does(order):
    assert log_density(jnp.array((0.0, 0.0, 1.0)[order]), 1.0, order) == -jnp.inf
    assert jnp.isfinite(log_density(jnp.array(1e4), 1.0, order))


@pytest.mark.parametrize("order", ORDERS)
def test_the_cdf_is_the_integrated_density(order, dtype):
    x = np.array([-3.0, -1.1, -0.7, -0.4, 0.0, 0.2, 0.7, 0.9, 2.5])
    mass = integrated(order, -np.inf, np.inf)
    want = [integrated(order, -np.inf, b) / mass for b in x]
    found = cdf(jnp.asarray(x, dtype), SIGMA, order)
    assert found.dtype == dtype
    np.testing.assert_allclose(found, want, atol=max(1e-13, 4 * float(jnp.finfo(dtype).eps)))


@pytest.mark.parametrize("order", ORDERS)
def test_the_inverse_undoes_the_cdf(order, dtype):
    eps = float(jnp.finfo(dtype).eps)
    u = jnp.linspace(0, 1, 1002, dtype=dtype)[1:-1]
    x = inverse_cdf(u, SIGMA, order)
    assert x.dtype == dtype
    assert jnp.all(jnp.diff(x) > 0)
    np.testing.assert_allclose(cdf(x, SIGMA, order), u, atol=8 * eps)
    # the other way round loses digits where the density vanishes and the CDF is flat
    x = jnp.asarray([-2.5, -1.5, -0.5, 0.3, 0.5, 1.2, 2.0], dtype)
    back = inverse_cdf(cdf(x, SIGMA, order), SIGMA, order)
    np.testing.assert_allclose(back, x, atol=4000 * eps)


@pytest.mark.parametrize("order", ORDERS)
def test_the_tails_are_finite_and_right(order, dtype):
    """The outermost midpoints of cells, 2^-24 in float32 and 2^-33 in float64."""
    outermost = 2.0 ** (-24 if dtype == jnp.float32 else -33)
    u = jnp.asarray([outermost, 3 * outermost, 1e-3], dtype)
    want = [
        -SIGMA * optimize.brentq(lambda t, p=p: tail(t, order) - p, 0, 10, xtol=1e-14)  # pyright: ignore
        for p in np.asarray(u, float)
    ]
    lower = inverse_cdf(u, SIGMA, order)
    np.testing.assert_allclose(lower, want, rtol=20 * float(jnp.finfo(dtype).eps))
    # both tails alike; in float32 1 - 2^-24 is the last number below 1
    np.testing.assert_allclose(
        inverse_cdf(1 - u[:2], SIGMA, order), -lower[:2], rtol=20 * float(jnp.finfo(dtype).eps)
    )


@pytest.mark.parametrize("order", ORDERS)
def test_the_inverse_is_right_at_the_smallest_probabilities(order, dtype):
    u = jnp.asarray([1e-37, 1e-30, 1e-20], dtype)
    want = [
        -SIGMA * optimize.brentq(lambda t, p=p: np.log(tail(t, order) / p), 0, 30, xtol=1e-14)  # pyright: ignore
        for p in np.asarray(u, float)
    ]
    eps = float(jnp.finfo(dtype).eps)
    np.testing.assert_allclose(inverse_cdf(u, SIGMA, order), want, rtol=20 * eps)


@pytest.mark.parametrize("order", ORDERS)
def test_the_inverse_has_the_derivative_of_an_inverse(order, dtype):
    u = jnp.asarray([1e-20, 1e-3, 0.2, 0.3, 0.6, 0.99], dtype)
    slopes = jax.vmap(jax.jacfwd(lambda u: inverse_cdf(u, SIGMA, order)))(u)
    want = jnp.exp(-log_density(inverse_cdf(u, SIGMA, order), SIGMA, order))
    np.testing.assert_allclose(slopes, want, rtol=500 * float(jnp.finfo(dtype).eps))
    back = jax.vmap(jax.grad(lambda u: inverse_cdf(u, SIGMA, order)))(u)
    np.testing.assert_allclose(back, slopes, rtol=1e-6)
    if order != 1:  # where the density of order 1 vanishes
        middle = jax.grad(lambda u: inverse_cdf(u, SIGMA, order))(jnp.asarray(0.5, dtype))
        np.testing.assert_allclose(middle, 1 / density(order)(0.0), rtol=1e-5)


@pytest.mark.parametrize("order", ORDERS)
def test_far_away_all_is_at_its_limit(order, dtype):
    far = jnp.asarray([-jnp.inf, -jnp.finfo(dtype).max, jnp.finfo(dtype).max, jnp.inf], dtype)
    np.testing.assert_array_equal(cdf(far, SIGMA, order), [0, 0, 1, 1])
    np.testing.assert_array_equal(derivative(far, SIGMA, order), 0)
    np.testing.assert_array_equal(log_density(far, SIGMA, order), -jnp.inf)
    slopes = jax.vmap(jax.grad(lambda x: cdf(x, SIGMA, order)))(far)
    np.testing.assert_array_equal(slopes, 0)


@pytest.mark.parametrize("order", ORDERS)
def test_samples_pass_a_kolmogorov_smirnov_test(order, dtype):
    u = jax.random.uniform(jax.random.key(order), (20_000,), dtype, minval=2**-24, maxval=1)
    x = np.asarray(inverse_cdf(u, SIGMA, order), float)
    grid = np.linspace(-6 * SIGMA, 6 * SIGMA, 24_001)
    mass = integrate.cumulative_trapezoid(density(order)(grid), grid, initial=0)
    assert stats.kstest(x, lambda x: np.interp(x, grid, mass)).pvalue > 1e-3
    assert stats.kstest(x, stats.norm(scale=1.1 * SIGMA).cdf).pvalue < 1e-6  # it is not blind


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("fun", FUNCTIONS)
def test_jit_and_vmap_change_nothing(fun, order, dtype):
    x = jnp.linspace(0.05, 0.95, 6, dtype=dtype).reshape(2, 3)
    sigma = jnp.asarray([0.5, 2.0], dtype)
    want = jnp.stack([fun(row, s, order) for row, s in zip(x, sigma, strict=True)])
    mapped = jax.vmap(jax.vmap(lambda x, s: fun(x, s, order), in_axes=(0, None)))
    np.testing.assert_allclose(
        jax.jit(mapped)(x, sigma), want, atol=50 * float(jnp.finfo(dtype).eps)
    )


@pytest.mark.parametrize("fun", FUNCTIONS)
def test_single_precision_stays_so_where_double_is_on(fun, x64):
    x = jnp.asarray([0.2, 0.7], jnp.float32)
    for order in ORDERS:
        assert jax.eval_shape(lambda x, order=order: fun(x, 0.5, order), x).dtype == jnp.float32


@pytest.mark.parametrize("fun", FUNCTIONS)
@pytest.mark.parametrize("order", [3, -1])
def test_another_order_is_refused(fun, order):
    # as users call it, without the type checker of the tests
    with pytest.raises(ValueError, match="order must be 0, 1 or 2"):
        inspect.unwrap(fun)(jnp.array(0.3), 1.0, order)
