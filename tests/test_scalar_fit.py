"""The fit of NewtonCG to its samples: exact for quadratics, and its errors known elsewhere."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import half_space, smoothed_half_space

from smoothdiff._solvers._scalar_fit import fit

DIRECTION = np.array([0.6, 0.8])


@jax.jit
def told(points, values, valid, at):
    """All that a fit says at a place; compiled once for each number of samples and dtype."""
    model = fit(points, values, valid)
    slope, exact = jax.grad(model.value)(at), jax.hessian(model.value)(at)
    along = jnp.ones_like(at) if at.size != 2 else jnp.asarray(DIRECTION, at.dtype)
    return {
        "model": model,
        "value": model.value(at),
        "grad": model.grad(at),
        "hessian": jax.vmap(model.curvature(at))(jnp.eye(at.size, dtype=at.dtype)),
        "diagonal": model.curvature_diagonal(at),
        "grad by AD": slope,
        "hessian by AD": exact,
        "value_stderr": model.value_stderr(at),
        "difference_stderr": model.difference_stderr(at),
        "grad_stderr": model.grad_stderr(at),
        "curvature_stderr": model.curvature_stderr(at, along),
    }


def samples(n, m, dtype, seed=0):
    points = np.random.default_rng(seed).normal(size=(m, n))
    return points.astype(dtype), np.ones(m, bool)


def rough(points):
    """Hard edges on a bend: no quadratic."""
    return np.sum(np.floor(2 * points), axis=1) + np.sin(3 * points[:, 0])


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
    at = np.asarray(at, dtype)
    found = told(points, np.asarray(value(points), dtype), valid, at)
    tolerance = (1e-6 if dtype == np.float64 else 1e-2) * np.max(np.abs(bend))
    assert found["value"].dtype == dtype
    np.testing.assert_allclose(found["value"], smoothed(at), atol=tolerance)
    np.testing.assert_allclose(found["grad"], slope(at), atol=tolerance)
    np.testing.assert_allclose(found["hessian"], bend, atol=tolerance)
    np.testing.assert_allclose(found["diagonal"], np.diag(bend), atol=tolerance)


def test_fewer_samples_than_a_quadratic_has_numbers_still_give_a_descent_direction(x64):
    points, valid = samples(20, 12, np.float64)
    slope = np.linspace(1, 2, 20)
    grad = jax.jit(lambda *data: fit(*data).grad(jnp.zeros(20)))(points, points @ slope, valid)
    cosine = grad @ slope / np.linalg.norm(slope)
    # of a random direction the samples see a share of 12 in 20, and the fit no more than that
    assert 0.6 < cosine / np.linalg.norm(grad) < 1


@pytest.mark.parametrize("at", [(0.0, 0.0), (0.6, -1.3)], ids=["here", "elsewhere"])
def test_derivatives_are_those_of_the_value(at, x64):
    points, valid = samples(2, 30, np.float64)
    found = told(points, rough(points), valid, np.array(at))
    assert found["model"].radial > 0
    close: dict[str, Any] = {"rtol": 1e-9, "atol": 1e-9}
    np.testing.assert_allclose(found["grad"], found["grad by AD"], **close)
    np.testing.assert_allclose(found["hessian"], found["hessian by AD"], **close)
    np.testing.assert_allclose(found["diagonal"], np.diagonal(found["hessian by AD"]), **close)


def test_standard_errors_are_those_of_the_gaussian_process_by_quadrature(x64):
    """The covariance of the smoothed function, given the samples, without any closed form."""
    points, valid = samples(2, 14, np.float64)
    # one far away, which counts less
    points[0] = [4.0, -3.0]
    at = np.array([0.6, -0.3])
    found = told(points, rough(points), valid, at)
    model = found["model"]
    assert model.radial > 0
    assert model.closeness[0] < 0.2
    exact = posterior(model, jnp.asarray(at), jnp.asarray(DIRECTION))
    for name, variance in exact.items():
        error = found[f"{name}_stderr"]
        np.testing.assert_allclose(error, np.sqrt(variance), rtol=1e-6, err_msg=name)


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
    direction = jnp.asarray(DIRECTION)

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

    @jax.jit
    def both(keys):
        smoothed = lambda u: smoothed_half_space(u, jnp.ones(2))
        value, zero = smoothed(at), smoothed(jnp.zeros(2))
        bent = jax.hessian(smoothed)(at) @ direction @ direction
        exact = {"value": value, "difference": value - zero, "grad": jax.grad(smoothed)(at)}
        return jax.lax.map(one, keys), exact | {"curvature": bent}

    found, exact = both(jax.random.split(jax.random.key(0), 200))
    for name, (estimates, errors) in found.items():
        missed = np.sqrt(np.mean((np.asarray(estimates) - np.asarray(exact[name])) ** 2))
        assert 0.5 < missed / np.sqrt(np.mean(errors**2)) < 2, name


@pytest.mark.parametrize("nonsense", [0.0, np.nan, np.inf, 1e30])
def test_invalid_samples_do_not_count(nonsense, x64):
    points, valid = samples(2, 30, np.float64)
    values, at = rough(points), np.array([0.3, 0.2])
    some = slice(0, 24)
    valid[24:] = False
    values[24:] = nonsense
    more = told(points, values, valid, at)
    less = told(points[some], values[some], valid[some], at)
    close: dict[str, Any] = {"rtol": 1e-9, "atol": 1e-9}
    for name in ("value", "grad", "hessian", "value_stderr", "grad_stderr"):
        np.testing.assert_allclose(more[name], less[name], err_msg=name, **close)


@pytest.mark.parametrize("shift", [0.0, 30.0])
def test_what_a_round_has_in_common_says_nothing(shift, known, x64):
    value, smoothed, slope, _ = known
    points, valid = samples(3, 40, np.float64)
    rounds = np.arange(40) // 8
    # a quadratic, and a number of each round
    values = value(points) + shift * np.random.default_rng(2).normal(size=5)[rounds]
    points, values, valid, rounds = map(jnp.asarray, (points, values, valid, rounds))
    model = jax.jit(fit)(points, values, valid, rounds)
    here = jnp.zeros(3)
    np.testing.assert_allclose(model.grad(here), slope(np.zeros(3)), atol=0.02)
    assert model.noise < 0.1
    if not shift:
        assert model.value(here) == pytest.approx(smoothed(np.zeros(3)), abs=0.02)
    else:
        assert jnp.linalg.norm(fit(points, values, valid).grad(here) - slope(np.zeros(3))) > 1


@pytest.mark.parametrize("constant", [0.0, -7.25, 1e20])
def test_constant_values_have_no_slope(constant, dtype):
    points, valid = samples(3, 20, dtype)
    found = told(points, np.full(20, constant, dtype), valid, np.ones(3, dtype))
    assert found["value"] == np.asarray(constant, dtype)
    np.testing.assert_array_equal(found["grad"], 0)
    np.testing.assert_array_equal(found["hessian"], 0)
    for name in ("value_stderr", "difference_stderr", "grad_stderr"):
        assert np.all((found[name] >= 0) & (found[name] < 1e-3)), name


@pytest.mark.parametrize(("scale", "shift"), [(1e-6, 0.0), (1e4, -3e4)])
def test_the_units_of_the_values_do_not_matter(scale, shift, x64):
    points, valid = samples(2, 30, np.float64)
    values, at = rough(points), np.array([0.3, 0.2])
    one, other = (told(points, v, valid, at) for v in (values, scale * values + shift))
    np.testing.assert_allclose(other["value"], scale * one["value"] + shift, rtol=1e-7)
    for name in ("grad", "grad_stderr"):
        np.testing.assert_allclose(other[name], scale * one[name], rtol=1e-7)
