"""Standard errors cover as often as they promise, for every transform and every kind of sample."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import (
    PLAIN,
    Widened,
    assert_same,
    boxes,
    half_space,
    keys,
    smoothed_half_space,
    taylor,
)
from scipy import stats

import smoothdiff as sd

THETA = jnp.array([0.1, -0.2, 0.3])
SIGMA = np.float32(0.5)
PAIRS = sd.Gaussian(antithetic=True)


def corner(x):
    """A step in each of three dimensions: one where all coordinates are positive."""
    return jnp.all(x > 0).astype(x.dtype)


def smoothed_corner(theta, sigma):
    return jnp.prod(jax.scipy.stats.norm.cdf(theta / sigma))


def steps(x):
    return jnp.sum((x > 0).astype(x.dtype))


def smoothed_steps(theta, sigma):
    return jnp.sum(jax.scipy.stats.norm.cdf(theta / sigma))


FUNCTIONS = {
    "half-space": (half_space, smoothed_half_space),
    "corner": (corner, smoothed_corner),
    "steps": (steps, smoothed_steps),
}


def coverage(found, error, exact, groups):
    """How often the exact value lies in the 95 % t-interval around the estimate, elementwise."""
    width = stats.t.ppf(0.975, groups - 1) * np.asarray(error)
    return np.mean(np.abs(np.asarray(found) - np.asarray(exact)) <= width, axis=0)


@pytest.mark.slow
@pytest.mark.parametrize("antithetic", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_coverage_at_256_samples(antithetic):
    """Value and gradient: 93 to 97 %, measured 93.2 to 95.8 %.

    Entries of the Hessian are products of two normal numbers, with heavier tails: 91 to 97 %,
    measured 91.6 to 95.9 %.
    """
    funs, smoothed = zip(*FUNCTIONS.values(), strict=True)
    sampler = sd.Gaussian(antithetic=antithetic)

    def estimates(index, key):
        fun = lambda x: jax.lax.switch(index, funs, x)
        model = sd.smooth_quadratic(fun, SIGMA, baseline="mean", num_samples=256, sampler=sampler)(
            key, THETA
        )
        unit = jnp.eye(3)
        errors = (*model.stderr, jax.vmap(model.hessian_stderr)(unit))
        return (model.value, model.grad, jax.vmap(model.hessian.mv)(unit)), errors

    over_keys = lambda i: jax.lax.map(lambda k: estimates(i, k), keys(2000), batch_size=100)
    run = jax.jit(over_keys)
    at = lambda i: taylor(lambda t: jax.lax.switch(i, [of_sigma(f) for f in smoothed], t))(THETA)
    exact = jax.jit(at)
    for i, name in enumerate(FUNCTIONS):
        found, errors = run(i)
        triples = zip(found, errors, exact(i), strict=True)
        covered = [coverage(*triple, 128 if antithetic else 256) for triple in triples]
        for share, low in zip(covered, (0.93, 0.93, 0.91), strict=True):
            assert np.all((share >= low) & (share <= 0.97)), (name, covered)


def of_sigma(smoothed):
    return lambda theta: smoothed(theta, jnp.full(3, SIGMA))


SITUATIONS = {
    "plain": {},
    "pairs, center": {"sampler": PAIRS, "baseline": "center", "num_samples": 129},
    "weighted, bounds": {"sampler": Widened(), "bounds": (-0.5, 0.6)},
    "drop": {"nonfinite": "drop"},
}
MORE_SITUATIONS = {
    "none": {"baseline": "none"},
    "center": {"baseline": "center", "num_samples": 129},
    "pairs": {"sampler": PAIRS},
    "weighted": {"sampler": Widened()},
    "bounds": {"bounds": (-0.5, 0.6)},
    "chunks": {"batch_size": 50},
}


@pytest.mark.parametrize(
    "changes",
    [pytest.param(changes, id=name) for name, changes in SITUATIONS.items()]
    + [pytest.param(c, id=name, marks=pytest.mark.slow) for name, c in MORE_SITUATIONS.items()],
)
def test_errors_are_the_spread_of_the_estimates(changes):
    """Over 2,000 keys: root mean square error as reported against the spread, within 7 %."""
    options: dict[str, Any] = {**PLAIN, "num_samples": 128, **changes}

    def fun(x):
        out = boxes(x) + x[0]
        return jnp.where(x[0] > 0.8, jnp.nan, out) if "nonfinite" in changes else out

    def estimates(key):
        model = sd.smooth_quadratic(fun, 0.4, **options)(key, THETA[:2])
        v = jnp.array([1.0, -2.0])
        return (model.value, model.grad, model.hessian.mv(v)), (
            *model.stderr,
            model.hessian_stderr(v),
        )

    found, errors = jax.jit(jax.vmap(estimates))(keys(2000))
    for estimate, error in zip(found, errors, strict=True):
        ratio = np.sqrt(np.mean(np.square(error), axis=0)) / np.std(estimate, axis=0)
        np.testing.assert_allclose(ratio, 1.0, atol=0.07)


FITTED = [("linear", sd.Gaussian()), ("gp", PAIRS)]
MORE_FITTED = [
    (baseline, sampler)
    for baseline in ("linear", "quadratic", "gp", "ad")
    for sampler in (sd.Gaussian(), PAIRS, sd.Sobol(replicates=8))
    if (baseline, sampler) not in FITTED
]


@pytest.mark.parametrize(
    ("baseline", "sampler"),
    FITTED + [pytest.param(*case, marks=pytest.mark.slow) for case in MORE_FITTED],
)
def test_what_a_fit_knows_is_no_error(baseline, sampler):
    """A large linear part is in the fit and not in the rows: errors are of what is left, to 25 %.

    Measured 0.89 to 1.19. Of a part 100 times as large as the rest they were 10 to 500 times too
    wide where rows were compared with the whole estimate.
    """
    fun = lambda x: 100 * jnp.sum(x) + boxes(x)
    num_samples = 129 if baseline == "ad" else 128
    options: Any = {"num_samples": num_samples, "baseline": baseline, "sampler": sampler}
    v = jnp.array([1.0, -2.0])

    def estimates(key):
        model = sd.smooth_quadratic(fun, 0.5, **options)(key, THETA[:2])
        jacobian, error = sd.smooth_jacobian(fun, 0.5, stderr=True, **options)(key, THETA[:2])
        return (model.value, model.grad, jacobian, model.hessian.mv(v)), (
            *model.stderr,
            error,
            model.hessian_stderr(v),
        )

    found, errors = jax.jit(lambda keys: jax.lax.map(estimates, keys))(keys(400))
    for estimate, error in zip(found, errors, strict=True):
        ratio = np.sqrt(np.mean(np.square(error), axis=0)) / np.std(estimate, axis=0)
        assert np.all((ratio > 0.8) & (ratio < 1.25)), ratio


@pytest.mark.parametrize("antithetic", [False, True])
def test_error_of_the_value_is_the_textbook_formula(antithetic, key, x64):
    sampler = sd.Gaussian(antithetic=antithetic)
    g = sd.smooth(
        lambda x: (boxes(x), boxes(x)),
        0.4,
        num_samples=32,
        baseline="mean",
        sampler=sampler,
        has_aux=True,
        stderr=True,
    )
    (_, f), error = jax.jit(g)(key, np.asarray(THETA[:2], float))
    f = np.asarray(f)
    if antithetic:
        f = f.reshape(16, 2).mean(axis=1)
    np.testing.assert_allclose(error, np.std(f, ddof=1) / np.sqrt(len(f)), rtol=1e-12)


@pytest.mark.parametrize("baseline", ["mean", "linear"])
def test_error_of_a_jacobian_is_that_of_each_output(baseline, key):
    x = THETA[:2]
    image = lambda x: {"a": jnp.stack([boxes(x), x[0] ** 2]), "b": half_space(x)}
    options: dict[str, Any] = {**PLAIN, "baseline": baseline, "num_samples": 32, "stderr": True}

    @jax.jit
    def run():
        jacobian = sd.smooth_jacobian(image, 0.4, **options)(key, x)
        value = sd.smooth(image, 0.4, **options)(key, x)
        pixels = (
            lambda x: image(x)["a"][0],
            lambda x: image(x)["a"][1],
            lambda x: image(x)["b"],
        )
        one = [sd.smooth_value_and_grad(pixel, 0.4, **options)(key, x) for pixel in pixels]
        return (value, jacobian), one

    ((value, value_error), (jacobian, error)), ones = run()
    flat = lambda tree: np.concatenate([tree["a"], tree["b"][None]])
    assert_same(flat(value), np.stack([one[0][0] for one in ones]))
    assert_same(flat(value_error), np.stack([one[1][0] for one in ones]))
    assert_same(flat(jacobian), np.stack([one[0][1] for one in ones]))
    assert_same(flat(error), np.stack([one[1][1] for one in ones]))


def test_error_of_a_hessian_is_that_of_its_columns(key):
    x = THETA[:2]
    options: dict[str, Any] = {**PLAIN, "num_samples": 32, "stderr": True}

    @jax.jit
    def run():
        product = sd.smooth_hvp(boxes, 0.4, **options)
        columns = jax.lax.map(lambda unit: product(key, x, unit), jnp.eye(2))
        return sd.smooth_hessian(boxes, 0.4, **options)(key, x), columns

    (hessian, error), (columns, column_errors) = run()
    assert_same(hessian, columns.T)
    assert_same(error, column_errors.T)


@pytest.mark.parametrize("antithetic", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_errors_of_leaves_that_are_differentiated_by_ad(antithetic):
    """d/dy of y^2 step(x) is 2 y step(x), with the spread of a coin."""
    fun = lambda p: p["y"] ** 2 * half_space(p["x"])
    sigma = {"x": SIGMA, "y": None}
    options: dict[str, Any] = {
        "num_samples": 128,
        "baseline": "mean",
        "stderr": True,
        "sampler": sd.Gaussian(antithetic=antithetic),
    }
    p = {"x": THETA, "y": jnp.array(1.5)}
    g = jax.jit(jax.vmap(lambda key: sd.smooth_grad(fun, sigma, **options)(key, p)))
    found, error = g(keys(2000))
    for leaf in ("x", "y"):
        ratio = np.sqrt(np.mean(np.square(error[leaf]), axis=0)) / np.std(found[leaf], axis=0)
        np.testing.assert_allclose(ratio, 1.0, atol=0.07)
    if not antithetic:
        share = float(jax.jit(of_sigma(smoothed_half_space))(THETA))
        coin = 2 * 1.5 * np.sqrt(share * (1 - share) / 128)
        np.testing.assert_allclose(np.mean(error["y"]), coin, rtol=0.02)


def test_the_error_of_a_complex_leaf_is_that_of_each_part():
    """d/dc of the real part of c exp(ix), whose two parts spread apart from each other."""
    fun = lambda p: jnp.real(jax.lax.complex(jnp.cos(p["x"]), jnp.sin(p["x"])) * p["c"])
    options: dict[str, Any] = {**PLAIN, "num_samples": 128, "stderr": True}
    p = {"x": jnp.float32(0.2), "c": jnp.asarray(1 + 0j, jnp.complex64)}
    g = lambda key: sd.smooth_grad(fun, {"x": 0.5, "c": None}, **options)(key, p)
    found, error = (leaf["c"] for leaf in jax.jit(jax.vmap(g))(keys(2000)))
    for part in (np.real, np.imag):
        ratio = np.sqrt(np.mean(np.square(part(error)))) / np.std(part(found))
        np.testing.assert_allclose(ratio, 1.0, atol=0.07)


def test_errors_of_a_constant_and_of_an_offset(key):
    x = THETA[:2]

    @jax.jit
    def run(scale, offset):
        fun = lambda x: scale * boxes(x) + offset
        options: dict[str, Any] = {**PLAIN, "num_samples": 32, "stderr": True}
        first = sd.smooth_value_and_grad(fun, 0.4, **options)(key, x)[1]
        return first, sd.smooth_hvp(fun, 0.4, **options)(key, x, x)[1]

    assert all(np.all(leaf == 0) for leaf in jax.tree.leaves(run(0.0, 3.0)))
    assert_same(run(1.0, 1024.0), run(1.0, 0.0), scale=100)


@pytest.mark.parametrize(("sampler", "num_samples"), [(sd.Gaussian(), 1), (PAIRS, 2)])
def test_one_group_of_samples_has_no_error(sampler, num_samples, key):
    options: dict[str, Any] = {**PLAIN, "sampler": sampler, "num_samples": num_samples}
    for transform in (sd.smooth, sd.smooth_grad, sd.smooth_jacobian, sd.smooth_hessian):
        with pytest.raises(ValueError, match=r"at least two .* raise num_samples"):
            jax.eval_shape(transform(boxes, 0.4, **options, stderr=True), key, THETA[:2])
    make = sd.smooth_quadratic(boxes, 0.4, **options)
    with pytest.raises(ValueError, match="at least two"):
        jax.eval_shape(lambda: make(key, THETA[:2]).stderr)
