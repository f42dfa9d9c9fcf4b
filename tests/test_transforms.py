"""The transforms agree with AD of `smooth`, with the published formulas, and with closed forms."""

import logging
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import (
    CASES,
    PLAIN,
    Widened,
    assert_same,
    assert_unbiased,
    boxes,
    keys,
    smoothed_boxes,
    smoothed_step,
    step,
)

import smoothdiff as sd


def derivatives(g):
    """Value, gradient and Hessian of g(theta, sigma) in both of its arguments together."""

    def joint(*at):
        def first(at):
            value, grad = jax.value_and_grad(lambda at: g(*at))(at)
            return grad, (value, grad)

        second, (value, grad) = jax.jacfwd(first, has_aux=True)(at)
        return {"value": value, "grad": grad, "hessian": second}

    return joint


def estimates(derived, fun, num_keys, **options):
    """The same derivatives of the estimate, for many keys."""

    def for_key(key, theta, sigma):
        g = lambda theta, sigma: sd.smooth(fun, sigma, **options)(key, theta)
        return derived(g)(theta, sigma)

    run = jax.jit(jax.vmap(for_key, in_axes=(0, None, None)))
    return lambda theta, sigma: run(keys(num_keys), theta, sigma)


# ---------------------------------------------------------------------------------------------
# closed forms


@pytest.mark.parametrize("name", CASES)
def test_every_derivative_has_its_closed_form(name):
    case = CASES[name]
    theta, sigma = jnp.array(case.theta), jnp.array(case.sigma)
    found = estimates(derivatives, case.fun, 512, **PLAIN, num_samples=1024)(theta, sigma)
    assert_unbiased(found, derivatives(case.smoothed)(theta, sigma), resolution=0.2)


def test_third_derivatives():
    case = CASES["half-space"]
    third = lambda g: jax.jacfwd(jax.hessian(g))
    theta, sigma = jnp.array(case.theta), jnp.array(case.sigma)
    g = lambda sigma: sd.smooth(case.fun, sigma, **PLAIN, num_samples=64)
    run = jax.jit(jax.vmap(lambda k: third(lambda t: g(sigma)(k, t))(theta)))
    exact = third(lambda t: case.smoothed(t, sigma))(theta)
    assert_unbiased(run(keys(8192)), exact, resolution=0.08)


@pytest.mark.parametrize("baseline", ["none", "mean", "center"])
def test_weighted_samples_are_unbiased(baseline):
    theta, sigma = jnp.array(CASES["boxes"].theta), jnp.array(CASES["boxes"].sigma)
    options: dict[str, Any] = {"sampler": Widened(), "baseline": baseline, "num_samples": 65}
    found = estimates(derivatives, boxes, 8192, **options)(theta, sigma)
    assert_unbiased(found, derivatives(smoothed_boxes)(theta, sigma), resolution=0.1)


@pytest.mark.parametrize("antithetic", [False, True])
@pytest.mark.parametrize("baseline", ["none", "mean", "center"])
def test_unbiased_at_every_number_of_samples(antithetic, baseline):
    fun = lambda x: x**3 + 2 * (x > 0).astype(x.dtype)

    def smoothed(theta, sigma):
        return theta**3 + 3 * theta * sigma**2 + 2 * smoothed_step(theta[None], sigma[None])

    def first_two(key, num):
        options: dict[str, Any] = {
            "num_samples": num + (baseline == "center"),
            "baseline": baseline,
            "sampler": sd.Gaussian(antithetic=antithetic),
        }
        model = sd.smooth_quadratic(fun, 0.5, **options)(key, theta)
        return model.value, model.grad, model.hessian.as_matrix()[0, 0]

    theta = jnp.array(0.7)
    at = (theta, jnp.array(0.5))
    exact = smoothed(*at), jax.grad(smoothed)(*at), jax.hessian(smoothed)(*at)
    for num in (2, 4, 8, 64):
        found = jax.jit(jax.vmap(lambda key, num=num: first_two(key, num)))(keys(2**18 // num))
        assert_unbiased(found, exact, resolution=0.04)


def test_a_sigma_for_each_leaf_can_be_differentiated():
    def fun(p):
        return jnp.sum(p["a"] ** 2) * p["b"] + (p["b"] > 0).astype(p["b"].dtype)

    def smoothed(p, s):
        square = jnp.sum(p["a"] ** 2) + 2 * s["a"] ** 2
        return square * p["b"] + smoothed_step(p["b"][None], s["b"][None])

    second = lambda g: jax.hessian(g, 1)
    p = {"a": jnp.array([0.5, -1.0]), "b": jnp.array(0.4)}
    s = {"a": jnp.array(0.6), "b": jnp.array(0.8)}
    found = estimates(second, fun, 1024, **PLAIN, num_samples=512)(p, s)
    # leaf (b, a) is zero: hold all leaves to the size of the largest
    pack = lambda tree, axis: jnp.stack(jax.tree.leaves(tree), axis)
    assert_unbiased(pack(found, 1), pack(second(smoothed)(p, s), 0), resolution=0.2)


def test_mixed_derivative_keeps_the_variance_reduction():
    """d2/dx dc of c^2 step(x) + 100 c: the offset 100 in d/dc is what a baseline must remove."""
    fun = lambda x, c: c**2 * step(x) + 100 * c
    theta, sigma, c = jnp.array([0.2]), 0.5, jnp.array(1.5)

    def mixed(g):
        return lambda x, c: jax.jacfwd(jax.grad(g), 1)(x, c)

    exact = mixed(lambda x, c: c**2 * smoothed_step(x, jnp.array([sigma])))(theta, c)
    spread = {}
    for baseline in ("none", "mean", "center"):
        g = sd.smooth(fun, sigma, baseline=baseline, num_samples=257, sampler=sd.Gaussian())
        run = jax.jit(jax.vmap(lambda k, g=g: mixed(lambda x, c: g(k, x, c))(theta, c)))
        found = run(keys(1024))
        assert_unbiased(found, exact, resolution=0.2)
        spread[baseline] = float(jnp.std(found))
    assert spread["mean"] < spread["none"] / 30
    assert spread["center"] < spread["none"] / 30


# ---------------------------------------------------------------------------------------------
# the formulas, summed by hand


@pytest.mark.parametrize("antithetic", [False, True])
@pytest.mark.parametrize("baseline", ["none", "mean", "center"])
def test_estimates_are_the_published_sums(antithetic, baseline, key, x64):
    """Value, gradient (eq. 17) and Hessian (eq. 20) from the points that the function saw."""
    theta, sigma, num = jnp.array([0.3, -0.2]), np.array([0.5, 2.0]), 12
    fun = lambda x: (boxes(x) + jnp.sum(x**3), x)
    options: dict[str, Any] = {
        "num_samples": num + (baseline == "center"),
        "baseline": baseline,
        "sampler": sd.Gaussian(antithetic=antithetic),
        "has_aux": True,
    }
    first = jax.jit(sd.smooth_value_and_grad(fun, sigma, **options))
    second = jax.jit(sd.smooth_hessian(fun, sigma, **options))
    ((value, points), grad), (hessian, same_points) = first(key, theta), second(key, theta)
    np.testing.assert_array_equal(points, same_points)
    z = (np.asarray(points) - np.asarray(theta)) / sigma
    if antithetic:
        np.testing.assert_allclose(z[::2], -z[1::2], atol=1e-14)
    f = np.asarray(jax.vmap(fun)(points)[0])
    group = np.arange(num) // (2 if antithetic else 1)
    b = {
        "none": np.zeros(num),
        "mean": np.array([f[group != i].mean() for i in group]),
        "center": np.full(num, fun(theta)[0]),
    }[baseline]
    outer = z[:, :, None] * z[:, None, :] - np.eye(2)
    np.testing.assert_allclose(value, f.mean(), rtol=1e-12)
    np.testing.assert_allclose(grad, np.mean((f - b)[:, None] * z, axis=0) / sigma, rtol=1e-11)
    by_hand = np.mean((f - b)[:, None, None] * outer, axis=0) / np.outer(sigma, sigma)
    np.testing.assert_allclose(hessian, by_hand, rtol=1e-11, atol=1e-13)


# ---------------------------------------------------------------------------------------------
# agreement with AD

PAIRS = sd.Gaussian(antithetic=True)
AGREE = {
    "plain": ("float32", {}),
    "pairs": ("float64", {"sampler": PAIRS}),
    "none": ("float32", {"baseline": "none"}),
    "center": ("float64", {"sampler": PAIRS, "baseline": "center", "num_samples": 25}),
    "weighted": ("float32", {"sampler": Widened()}),
    "chunks": ("float64", {"sampler": PAIRS, "batch_size": 10}),
    "bounds": ("float32", {"bounds": (-0.3, 0.5)}),
    "drop": ("float64", {"sampler": PAIRS, "nonfinite": "drop"}),
}


@pytest.mark.parametrize(("dtype", "changes"), AGREE.values(), ids=AGREE, indirect=["dtype"])
def test_transforms_agree_with_ad_of_smooth(changes, dtype, key):
    options: dict[str, Any] = {**PLAIN, "num_samples": 24, **changes}

    def fun(x):
        out = boxes(x) + jnp.sum(x**2)
        return jnp.where(x[0] > 1, jnp.nan, out) if "nonfinite" in options else out

    x, v = jnp.array([0.1, 0.2], dtype), jnp.array([0.5, -2.0], dtype)
    sigma = 0.4
    g = sd.smooth(fun, sigma, **options)

    def by_ad(x, v):
        f = lambda x: g(key, x)
        value, slope = jax.jvp(f, (x,), (v,))
        gradient, along = jax.linearize(jax.grad(f), x)
        return value, slope, gradient, jax.hessian(f)(x), along(v)

    def by_transforms(x, v):
        value, gradient = sd.smooth_value_and_grad(fun, sigma, **options)(key, x)
        hessian = sd.smooth_hessian(fun, sigma, **options)(key, x)
        product = sd.smooth_hvp(fun, sigma, **options)(key, x, v)
        return value, jnp.vdot(gradient, v), gradient, hessian, product

    def by_other_paths(x, v):
        """The code for standard errors, and the quadratic model, have paths of their own."""
        errors: dict[str, Any] = {**options, "stderr": True}
        model = sd.smooth_quadratic(fun, sigma, **options)(key, x)
        gradient = sd.smooth_grad(fun, sigma, **errors)(key, x)[0]
        return (
            (model.value, sd.smooth(fun, sigma, **errors)(key, x)[0]),
            (model.grad, gradient, sd.smooth_jacobian(fun, sigma, **options)(key, x)),
            (model.hessian.as_matrix(), sd.smooth_hessian(fun, sigma, **errors)(key, x)[0]),
            (model.hessian.mv(v), sd.smooth_hvp(fun, sigma, **errors)(key, x, v)[0]),
        )

    everything = lambda x, v: (by_ad(x, v), by_transforms(x, v), by_other_paths(x, v))
    want, found, others = jax.jit(everything)(x, v)
    assert all(leaf.dtype == dtype for leaf in want)
    assert_same(found, want, dtype)
    value, _, gradient, hessian, product = want
    for paths, exact in zip(others, (value, gradient, hessian, product), strict=True):
        for path in paths:
            assert path.dtype == dtype
            assert_same(path, exact, dtype)


def test_third_derivatives_agree_too(dtype, key):
    x, v = jnp.array([0.1, 0.2], dtype), jnp.array([0.5, -2.0], dtype)
    g = sd.smooth(boxes, 0.4, **PLAIN, num_samples=24)
    hessian = sd.smooth_hessian(boxes, 0.4, **PLAIN, num_samples=24)

    @jax.jit
    def run(x, v):
        third = jax.jacfwd(jax.hessian(lambda x: g(key, x)))(x)
        return jax.jvp(lambda x: hessian(key, x), (x,), (v,))[1], jnp.tensordot(third, v, axes=1)

    found, want = run(x, v)
    assert_same(found, want, dtype)


@pytest.mark.parametrize("wide", [False, True])
def test_jacobian_of_pytree_outputs_is_that_of_ad(wide, key, x64):
    """Fewer parameters than outputs and the reverse take different modes; stderr a third path."""

    def image(p):
        level = jnp.round(jnp.sum(p["a"]) + p["b"])
        return {"pixels": level * jnp.arange(6.0).reshape(2, 3), "loss": level**2}

    p = {"a": jnp.linspace(0.0, 1.0, 20 if wide else 2), "b": jnp.array(0.3)}
    s = {"a": 0.5, "b": jnp.array(0.25)}
    options: dict[str, Any] = {**PLAIN, "num_samples": 32}
    want = jax.jit(jax.jacrev(sd.smooth(image, s, **options), argnums=1))(key, p)
    found = jax.jit(sd.smooth_jacobian(image, s, **options))(key, p)
    assert found["pixels"]["a"].shape == (2, 3, p["a"].size)
    assert_same(found, want, np.float64)
    errors = sd.smooth_jacobian(image, s, **options, stderr=True)
    estimate, error = jax.jit(errors)(key, p)
    assert_same(estimate, want, np.float64)
    assert jax.tree.map(jnp.shape, error) == jax.tree.map(jnp.shape, want)


def test_without_jit_the_parts_are_compiled_as_wholes(caplog):
    """Op by op a first gradient would be 190 programs, which take seconds to compile."""
    jax.clear_caches()  # what other tests have compiled would not be counted
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        sd.smooth_grad(lambda x: jnp.sum(jnp.floor(x) ** 2), 0.3)(jax.random.key(0), jnp.ones(3))
    programs = sum("Finished XLA compilation" in r.getMessage() for r in caplog.records)
    assert 1 <= programs <= 40
