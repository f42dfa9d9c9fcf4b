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
    Several,
    Widened,
    assert_same,
    assert_unbiased,
    boxes,
    keys,
    smoothed_boxes,
    smoothed_step,
    step,
    taylor,
)

import smoothdiff as sd


def for_keys(num, estimate):
    """What `estimate(key)` gives for many keys, as one program."""
    return jax.jit(jax.vmap(estimate))(keys(num))


# ---------------------------------------------------------------------------------------------
# closed forms


def padded(name, size):
    """A function and its smoothed one, in `size` parameters of which the last may do nothing."""
    case = CASES[name]
    n = len(case.theta)
    fun = lambda x: jnp.asarray(case.fun(x[:n]))
    smoothed = lambda at: jnp.asarray(case.smoothed(at[:n], at[size : size + n]))
    rest = (1.0,) * (size - n)
    return fun, smoothed, (*case.theta, *rest, *case.sigma, *rest)


@pytest.mark.parametrize("size", [1, 3, 8])
def test_every_derivative_has_its_closed_form(size):
    """Value, first and second derivatives in parameters and sigma of all `CASES` of that size."""
    names = [n for n, case in CASES.items() if len(case.theta) in {3: (2, 3)}.get(size, (size,))]
    funs, smoothed, at = zip(*(padded(name, size) for name in names), strict=True)
    index, at = jnp.arange(len(names)), jnp.array(at)

    def estimate(key):
        def one(index, at):
            fun = lambda x: jax.lax.switch(index, funs, x)
            g = lambda at: sd.smooth(fun, at[size:], **PLAIN, num_samples=1024)(key, at[:size])
            return taylor(g)(at)

        return jax.lax.map(lambda case: one(*case), (index, at))

    found = for_keys(256, estimate)
    exact = lambda i, at: taylor(lambda at: jax.lax.switch(i, smoothed, at))(at)
    want = jax.jit(jax.vmap(exact))(index, at)
    for i, name in enumerate(names):
        pick = lambda tree, i=i, axis=0: jax.tree.map(lambda leaf: leaf.take(i, axis), tree)
        assert_unbiased(pick(found, axis=1), pick(want), resolution=0.2, name=name)


def test_third_derivatives():
    case = CASES["half-space"]
    third = lambda g: jax.jacfwd(jax.hessian(g))
    theta, sigma = jnp.array(case.theta), jnp.array(case.sigma)
    g = sd.smooth(case.fun, sigma, **PLAIN, num_samples=64)
    found = for_keys(8192, lambda k: third(lambda t: g(k, t))(theta))
    exact = jax.jit(third(lambda t: case.smoothed(t, sigma)))(theta)
    assert_unbiased(found, exact, resolution=0.08)


def test_weighted_samples_are_unbiased():
    at = jnp.array([*CASES["boxes"].theta, *CASES["boxes"].sigma])
    names = ("none", "mean", "center")
    options: dict[str, Any] = {"sampler": Widened(), "num_samples": 65}

    def estimate(key):
        g = lambda at: sd.smooth(boxes, at[2:], baseline=Several(*names), **options)(key, at[:2])
        return taylor(g)(at)

    found = for_keys(8192, estimate)
    exact = jax.jit(taylor(lambda at: smoothed_boxes(at[:2], at[2:])))(at)
    for name in names:
        own = tuple(part[name] for part in found)
        assert_unbiased(own, exact, resolution=0.1, name=name)


@pytest.mark.parametrize("antithetic", [False, True])
@pytest.mark.parametrize(
    "num_samples",
    [2, pytest.param(4, marks=pytest.mark.slow), 8, pytest.param(64, marks=pytest.mark.slow)],
)
def test_unbiased_at_every_number_of_samples(num_samples, antithetic):
    fun = lambda x: x**3 + 2 * (x > 0).astype(x.dtype)
    names = ("none", "mean", "center")
    options: dict[str, Any] = {
        "num_samples": num_samples + 1,  # one of them is the center
        "sampler": sd.Gaussian(antithetic=antithetic),
    }
    g = sd.smooth(fun, 0.5, baseline=Several(*names), **options)
    theta = jnp.array(0.7)
    found = for_keys(2**18 // num_samples, lambda key: taylor(lambda x: g(key, x))(theta))

    def smoothed(theta):
        return theta**3 + 3 * theta / 4 + 2 * smoothed_step(theta[None], jnp.array([0.5]))

    exact = jax.jit(taylor(smoothed))(theta)
    for name in names:
        own = tuple(part[name] for part in found)
        assert_unbiased(own, exact, resolution=0.04, name=name)


def test_a_sigma_for_each_leaf_can_be_differentiated():
    def fun(p):
        return jnp.sum(p["a"] ** 2) * p["b"] + (p["b"] > 0).astype(p["b"].dtype)

    def smoothed(p, s):
        square = jnp.sum(p["a"] ** 2) + 2 * s["a"] ** 2
        return square * p["b"] + smoothed_step(p["b"][None], s["b"][None])

    p = {"a": jnp.array([0.5, -1.0]), "b": jnp.array(0.4)}
    s = {"a": jnp.array(0.6), "b": jnp.array(0.8)}
    estimate = lambda key: jax.hessian(
        lambda s: sd.smooth(fun, s, **PLAIN, num_samples=512)(key, p)
    )(s)
    found, exact = for_keys(1024, estimate), jax.jit(jax.hessian(smoothed, 1))(p, s)
    # leaf (b, a) is zero: hold all leaves to the size of the largest
    pack = lambda tree, axis: np.stack(jax.tree.leaves(tree), axis)
    assert_unbiased(pack(found, 1), pack(exact, 0), resolution=0.2)


def test_mixed_derivative_keeps_the_variance_reduction():
    """d2/dx dc of c^2 step(x) + 100 c: the offset 100 in d/dc is what a baseline must remove."""
    fun = lambda x, c: c**2 * step(x) + 100 * c
    theta, sigma, c = jnp.array([0.2]), 0.5, jnp.array(1.5)
    mixed = lambda g: jax.jacfwd(jax.jacrev(g), 1)(theta, c)
    names = ("none", "mean", "center")
    g = sd.smooth(fun, sigma, baseline=Several(*names), num_samples=257, sampler=sd.Gaussian())
    found = for_keys(1024, lambda k: mixed(lambda x, c: g(k, x, c)))
    exact = jax.jit(lambda: mixed(lambda x, c: c**2 * smoothed_step(x, jnp.array([sigma]))))()
    for name in names:
        assert_unbiased(found[name], exact, resolution=0.2, name=name)
    spread = {name: np.std(found[name]) for name in names}
    assert spread["mean"] < spread["none"] / 30
    assert spread["center"] < spread["none"] / 30


# ---------------------------------------------------------------------------------------------
# the formulas, summed by hand


@pytest.mark.parametrize(
    ("baseline", "antithetic"),
    [
        ("none", False),
        ("mean", False),
        ("mean", True),
        ("center", True),
        pytest.param("none", True, marks=pytest.mark.slow),
        pytest.param("center", False, marks=pytest.mark.slow),
    ],
)
def test_estimates_are_the_published_sums(antithetic, baseline, key, x64):
    """Value, gradient (eq. 17) and Hessian (eq. 20) from the points that the function saw."""
    theta, sigma, num = jnp.array([0.3, -0.2]), np.array([0.5, 2.0]), 12
    fun = lambda x: (boxes(x) + jnp.sum(x**3), (x, boxes(x) + jnp.sum(x**3)))
    options: dict[str, Any] = {
        "num_samples": num + (baseline == "center"),
        "baseline": baseline,
        "sampler": sd.Gaussian(antithetic=antithetic),
        "has_aux": True,
    }
    first, second = (
        transform(fun, sigma, **options)
        for transform in (sd.smooth_value_and_grad, sd.smooth_hessian)
    )
    run = jax.jit(lambda: (first(key, theta), second(key, theta), fun(theta)[0]))
    ((value, (points, f)), grad), (hessian, (same_points, _)), center = run()
    np.testing.assert_array_equal(points, same_points)
    z = (np.asarray(points) - np.asarray(theta)) / sigma
    if antithetic:
        np.testing.assert_allclose(z[::2], -z[1::2], atol=1e-14)
    f = np.asarray(f)
    group = np.arange(num) // (2 if antithetic else 1)
    b = {
        "none": np.zeros(num),
        "mean": np.array([f[group != i].mean() for i in group]),
        "center": np.full(num, center),
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
    "center of pairs, bounds": (
        "float64",
        {"sampler": PAIRS, "baseline": "center", "num_samples": 25, "bounds": (-0.3, 0.5)},
    ),
    "weighted, drop": ("float32", {"sampler": Widened(), "nonfinite": "drop"}),
}
ALSO_AGREE = {
    "plain in double precision": ("float64", {}),
    "pairs": ("float64", {"sampler": PAIRS}),
    "none": ("float32", {"baseline": "none"}),
    "center": ("float64", {"sampler": PAIRS, "baseline": "center", "num_samples": 25}),
    "weighted": ("float32", {"sampler": Widened()}),
    "chunks": ("float64", {"sampler": PAIRS, "batch_size": 10}),
    "bounds": ("float32", {"bounds": (-0.3, 0.5)}),
    "drop": ("float64", {"sampler": PAIRS, "nonfinite": "drop"}),
}


@pytest.mark.parametrize(
    ("dtype", "changes"),
    [pytest.param(*case, id=name) for name, case in AGREE.items()]
    + [pytest.param(*c, id=name, marks=pytest.mark.slow) for name, c in ALSO_AGREE.items()],
    indirect=["dtype"],
)
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

    @jax.jit
    def run(p):
        errors = sd.smooth_jacobian(image, s, **options, stderr=True)(key, p)
        by_ad = jax.jacrev(sd.smooth(image, s, **options), argnums=1)(key, p)
        return by_ad, sd.smooth_jacobian(image, s, **options)(key, p), errors

    want, found, (estimate, error) = run(p)
    assert found["pixels"]["a"].shape == (2, 3, p["a"].size)
    assert_same(found, want, np.float64)
    assert_same(estimate, want, np.float64)
    assert jax.tree.map(jnp.shape, error) == jax.tree.map(jnp.shape, want)


def test_without_jit_the_parts_are_compiled_as_wholes(caplog):
    """Op by op a first gradient would be 190 programs, which take seconds to compile."""
    jax.clear_caches()  # what other tests have compiled would not be counted
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        sd.smooth_grad(lambda x: jnp.sum(jnp.floor(x) ** 2), 0.3)(jax.random.key(0), jnp.ones(3))
    programs = sum("Finished XLA compilation" in r.getMessage() for r in caplog.records)
    assert 1 <= programs <= 40
