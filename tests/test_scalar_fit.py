"""The fit of NewtonCG to its samples: exact for quadratics, and its errors known elsewhere."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import half_space, smoothed_half_space

from smoothdiff._solvers._scalar_fit import fit

fitted = jax.jit(fit)


def samples(n, m, dtype, seed=0):
    points = np.random.default_rng(seed).normal(size=(m, n))
    return jnp.asarray(points, dtype), jnp.ones(m, bool)


def rough(points):
    """Hard edges on a bend: no quadratic."""
    return jnp.sum(jnp.floor(2 * points), axis=1) + jnp.sin(3 * points[:, 0])


def hessian(model, at):
    return jax.vmap(model.curvature(at))(jnp.eye(at.size, dtype=at.dtype))


@pytest.fixture(scope="module")
def known():
    """The value, gradient and Hessian of a quadratic, smoothed and not."""
    rng = np.random.default_rng(1)
    root, slope, constant = rng.normal(size=(3, 3)), rng.normal(size=3), 1.7
    bend = root + root.T
    value = lambda u: constant + u @ slope + np.sum(u @ bend * u, axis=-1) / 2
    smoothed = lambda u: value(u) + np.trace(bend) / 2
    return value, smoothed, lambda u: slope + bend @ u, bend


@pytest.mark.parametrize("at", [(0.0, 0.0, 0.0), (0.7, -0.4, 1.1)], ids=["here", "elsewhere"])
def test_a_quadratic_is_reproduced(at, known, dtype):
    value, smoothed, slope, bend = known
    points, valid = samples(3, 20, dtype)
    model = fitted(points, jnp.asarray(value(np.asarray(points)), dtype), valid)
    place, at = jnp.asarray(at, dtype), np.asarray(at)
    tolerance = (1e-6 if dtype == np.float64 else 1e-2) * np.max(np.abs(bend))
    assert model.value(place).dtype == dtype
    np.testing.assert_allclose(model.value(place), smoothed(at), atol=tolerance)
    np.testing.assert_allclose(model.grad(place), slope(at), atol=tolerance)
    np.testing.assert_allclose(hessian(model, place), bend, atol=tolerance)
    np.testing.assert_allclose(model.curvature_diagonal(place), np.diag(bend), atol=tolerance)


def test_fewer_samples_than_a_quadratic_has_numbers_still_give_a_descent_direction(x64):
    points, valid = samples(20, 12, np.float64)
    slope = np.linspace(1, 2, 20)
    model = fitted(points, points @ slope, valid)
    cosine = model.grad(points[0] * 0) @ slope / np.linalg.norm(slope)
    # of a random direction the samples see a share of 12 in 20, and the fit no more than that
    assert 0.6 < cosine / np.linalg.norm(model.grad(points[0] * 0)) < 1


@pytest.mark.parametrize("at", [(0.0, 0.0), (0.6, -1.3)], ids=["here", "elsewhere"])
def test_derivatives_are_those_of_the_value(at, x64):
    points, valid = samples(2, 30, np.float64)
    model, at = fitted(points, rough(points), valid), jnp.array(at)
    assert model.radial > 0
    close: dict[str, Any] = {"rtol": 1e-9, "atol": 1e-9}
    slope, exact = jax.jit(lambda f, at: (jax.grad(f.value)(at), jax.hessian(f.value)(at)))(
        model, at
    )
    np.testing.assert_allclose(model.grad(at), slope, **close)
    np.testing.assert_allclose(hessian(model, at), exact, **close)
    np.testing.assert_allclose(model.curvature_diagonal(at), jnp.diagonal(exact), **close)


def test_standard_errors_are_those_of_the_gaussian_process_by_quadrature(x64):
    """The covariance of the smoothed function, given the samples, without any closed form."""
    points, valid = samples(2, 14, np.float64)
    # one far away, which counts less
    points = points.at[0].set(jnp.array([4.0, -3.0]))
    model = fitted(points, rough(points), valid)
    assert model.radial > 0
    assert model.closeness[0] < 0.2
    at, v = jnp.array([0.6, -0.3]), jnp.array([0.6, 0.8])
    exact = posterior(model, at, v)
    found = {
        "value": model.value_stderr(at),
        "difference": model.difference_stderr(at),
        "grad": model.grad_stderr(at),
        "curvature": model.curvature_stderr(at, v),
    }
    for name, error in found.items():
        np.testing.assert_allclose(error, jnp.sqrt(exact[name]), rtol=1e-6, err_msg=name)


@jax.jit
def posterior(model, at, v):
    """Variances of the smoothed function and its derivatives: sums over the nodes, and AD."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(16)
    z = jnp.asarray(np.stack([a.ravel() for a in np.meshgrid(nodes, nodes)], axis=1))
    share = jnp.asarray(np.outer(weights, weights).ravel() / (2 * np.pi))
    points, near = model.points, model.closeness

    def kernel(a, b):
        product = a @ b.T / 2
        apart = jnp.sum((a[:, None] - b[None]) ** 2, axis=2)
        return product + model.curved * product**2 + model.radial * jnp.exp(-apart / 4)

    inner = kernel(points, points)
    ridge = (model.factor @ model.factor.T - jnp.outer(near, near) * inner)[0, 0]
    told = jnp.linalg.inv(inner + jnp.diag(ridge / near**2))

    def features(a):
        return share @ kernel(z + a[None], points)

    def covariance(a, b):
        prior = share @ kernel(z + a[None], z + b[None]) @ share
        return model.amplitude**2 * (prior - features(a) @ told @ features(b))

    def bends(a, b):
        along = lambda f, a: jax.jvp(lambda a: jax.jvp(f, (a,), (v,))[1], (a,), (v,))[1]
        return along(lambda a: along(lambda b: covariance(a, b), b), a)

    zero = jnp.zeros_like(at)
    slopes = jax.jacfwd(lambda a: jax.jacfwd(lambda b: covariance(a, b))(at))(at)
    # the value also depends on the constant, which only the samples tell of
    constant = model.amplitude**2 * (1 - jnp.sum(told @ features(at))) ** 2 / jnp.sum(told)
    return {
        "value": covariance(at, at) + constant,
        "difference": covariance(at, at) - 2 * covariance(at, zero) + covariance(zero, zero),
        "grad": jnp.diagonal(slopes),
        "curvature": bends(at, at),
    }


def test_standard_errors_are_calibrated_at_a_hard_edge(x64):
    at = jnp.array([0.3, -0.2])
    sigma = jnp.ones(2)
    smoothed = lambda u: smoothed_half_space(u, sigma)
    direction = jnp.array([0.6, 0.8])

    def one(key):
        points = jax.random.normal(key, (20, 2))
        model = fit(points, jax.vmap(half_space)(points), jnp.ones(20, bool))
        bent = model.curvature(at)(direction) @ direction
        zero = jnp.zeros(2)
        return {
            "value": (model.value(at), model.value_stderr(at)),
            "difference": (model.value(at) - model.value(zero), model.difference_stderr(at)),
            "grad": (model.grad(at), model.grad_stderr(at)),
            "curvature": (bent, model.curvature_stderr(at, direction)),
        }

    exact = {
        "value": smoothed(at),
        "difference": smoothed(at) - smoothed(jnp.zeros(2)),
        "grad": jax.grad(smoothed)(at),
        "curvature": jax.hessian(smoothed)(at) @ direction @ direction,
    }
    found = jax.jit(lambda keys: jax.lax.map(one, keys))(jax.random.split(jax.random.key(0), 200))
    for name, (estimates, errors) in found.items():
        missed = np.sqrt(np.mean((np.asarray(estimates) - np.asarray(exact[name])) ** 2))
        assert 0.5 < missed / np.sqrt(np.mean(errors**2)) < 2, name


@pytest.mark.parametrize("nonsense", [0.0, np.nan, np.inf, 1e30])
def test_invalid_samples_do_not_count(nonsense, x64):
    points, valid = samples(2, 30, np.float64)
    values = rough(points)
    spare, _ = samples(2, 6, np.float64, seed=5)
    more = fitted(
        jnp.concatenate([points, spare]),
        jnp.concatenate([values, jnp.full(6, nonsense)]),
        jnp.concatenate([valid, jnp.zeros(6, bool)]),
    )
    model, at = fitted(points, values, valid), jnp.array([0.3, 0.2])
    close: dict[str, Any] = {"rtol": 1e-9, "atol": 1e-9}
    np.testing.assert_allclose(more.value(at), model.value(at), **close)
    np.testing.assert_allclose(more.grad(at), model.grad(at), **close)
    np.testing.assert_allclose(hessian(more, at), hessian(model, at), **close)
    np.testing.assert_allclose(more.value_stderr(at), model.value_stderr(at), **close)
    np.testing.assert_allclose(more.grad_stderr(at), model.grad_stderr(at), **close)


@pytest.mark.parametrize("constant", [0.0, -7.25, 1e20])
def test_constant_values_have_no_slope(constant, dtype):
    points, valid = samples(3, 20, dtype)
    model, at = fitted(points, jnp.full(20, constant, dtype), valid), jnp.ones(3, dtype)
    assert model.value(at) == jnp.asarray(constant, dtype)
    np.testing.assert_array_equal(model.grad(at), 0)
    np.testing.assert_array_equal(model.curvature(at)(at), 0)
    for error in (model.value_stderr(at), model.difference_stderr(at), *model.grad_stderr(at)):
        assert 0 <= error < 1e-3


@pytest.mark.parametrize(("scale", "shift"), [(1e-6, 0.0), (1e4, -3e4)])
def test_the_units_of_the_values_do_not_matter(scale, shift, x64):
    points, valid = samples(2, 30, np.float64)
    values, at = rough(points), jnp.array([0.3, 0.2])
    model, other = fitted(points, values, valid), fitted(points, scale * values + shift, valid)
    np.testing.assert_allclose(other.value(at), scale * model.value(at) + shift, rtol=1e-7)
    np.testing.assert_allclose(other.grad(at), scale * model.grad(at), rtol=1e-7)
    np.testing.assert_allclose(other.grad_stderr(at), scale * model.grad_stderr(at), rtol=1e-7)
