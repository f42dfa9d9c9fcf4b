"""Fits that leave out what depends on a sample: refits by brute force, and standard errors."""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import assert_same, assert_unbiased, boxes, keys, quadratic_model
from scipy import stats

import smoothdiff as sd
from tests.parts import quick_of

KEY = jax.random.key(0)
PAIRS = sd.Gaussian(antithetic=True)


class Threes(sd.AbstractSampler):
    """Normal points of which three at a time are left out together; the last may be fewer."""

    gaussian: ClassVar[bool] = True

    def block(self, num_samples, n):
        return 1

    def group(self, num_samples, n):
        return 3

    def draw(self, key, start, count, num_samples, n, dtype):
        return sd.Gaussian().draw(key, start, count, num_samples, n, dtype)


class FittedPolynomial:
    """Least squares of raw monomials with NumPy, and the smoothed derivatives of the result."""

    def __init__(self, degree):
        self.degree = degree

    def design(self, z):
        columns = [np.ones(len(z)), *z.T]
        if self.degree == 2:
            self.pairs = np.stack(np.triu_indices(z.shape[1]), axis=1)
            columns += [z[:, i] * z[:, j] for i, j in self.pairs]
        return np.stack(columns, axis=1)

    def fit(self, z, f):
        n = z.shape[1]
        self.beta = np.linalg.lstsq(self.design(z), f, rcond=None)[0]
        self.slope, self.curvature = self.beta[1 : n + 1], np.zeros((n, n))
        if self.degree == 2:
            for (i, j), b in zip(self.pairs, self.beta[n + 1 :], strict=True):
                self.curvature[i, j] += b
                self.curvature[j, i] += b
        return self

    def predict(self, z):
        return self.design(z) @ self.beta

    def smoothed(self):
        return self.beta[0] + np.trace(self.curvature) / 2, self.slope, self.curvature


class FittedProcess:
    """A Gaussian process with a constant of any size, from its bordered system."""

    def __init__(self, length, ridge):
        self.length, self.ridge = length, ridge

    def kernel(self, x, y):
        n = x.shape[1]
        apart = np.sum((x[:, None] - y[None]) ** 2, axis=-1)
        return x @ y.T / n + np.exp(-apart / (2 * self.length**2 * n))

    def fit(self, z, f):
        num = len(z)
        system = np.ones((num + 1, num + 1))
        system[:num, :num] = self.kernel(z, z) + self.ridge * np.eye(num)
        system[num, num] = 0
        solution = np.linalg.solve(system, np.append(f, 0))
        self.z, self.alpha, self.constant = z, solution[:num], solution[num]
        return self

    def predict(self, z):
        return self.constant + self.kernel(z, self.z) @ self.alpha

    def smoothed(self):
        n = self.z.shape[1]
        wide = self.length**2 * n + 1
        height = (1 - 1 / wide) ** (n / 2) * np.exp(-np.sum(self.z**2, axis=1) / (2 * wide))
        value = self.constant + self.alpha @ height
        grad = self.z.T @ self.alpha / n + self.z.T @ (self.alpha * height) / wide
        outer = self.z[:, :, None] * self.z[:, None, :] / wide**2 - np.eye(n)[None] / wide
        return value, grad, np.einsum("i,ijk->jk", self.alpha * height, outer)


def refitted(make, z, f, groups):
    """Value, gradient and Hessian in units of sigma: each group corrected by a fit to the others.

    `groups` None: one fit to all. Samples that are NaN are left out of everything.
    """
    valid = np.isfinite(f)
    parts = [np.zeros(len(f), int)] if groups is None else [groups]
    residual, back = np.full(len(f), np.nan), []
    for group in np.unique(parts[0]):
        own = (parts[0] == group) & valid
        others = valid if groups is None else valid & ~own
        if not own.any():
            continue
        if others.any():
            fitted = make().fit(z[others], f[others])
            residual[own] = f[own] - fitted.predict(z[own])
            smoothed = fitted.smoothed()
        else:
            residual[own] = f[own]
            smoothed = (0.0, 0.0, 0.0)
        back.append([np.sum(own) / np.sum(valid) * part for part in smoothed])
    z, r = z[valid], residual[valid]
    n = z.shape[1]
    moments = r, r[:, None] * z, r[:, None, None] * (z[:, :, None] * z[:, None] - np.eye(n)[None])
    return [
        np.mean(m, axis=0) + sum(b) for m, b in zip(moments, zip(*back, strict=True), strict=True)
    ]


REFITS = {
    "linear": ("linear", lambda: FittedPolynomial(1)),
    "quadratic": ("quadratic", lambda: FittedPolynomial(2)),
    "gp": ("gp", lambda: FittedProcess(1.0, 0.1)),
    "gp of another length": (sd.GaussianProcess(0.4, 0.01), lambda: FittedProcess(0.4, 0.01)),
}
GROUPED = {
    "single": (sd.Gaussian(), 1),
    "pairs": (PAIRS, 2),
    "frames": (sd.Orthogonal(antithetic=False), 2),
    "replicates": (sd.Sobol(replicates=4), 12),
    "threes": (Threes(), 3),
    "one set": (sd.Sobol(), None),
}


CASES = [(name, False) for name in GROUPED] + [
    ("single", True),
    ("threes", True),
    ("one set", True),
]
QUICK = [("pairs", False), ("one set", False)]


@pytest.mark.parametrize("case", quick_of(CASES, QUICK), ids=str)
def test_leaving_out_is_refitting(case, x64):
    """48 samples (threes: 47) of a function with an offset, in two dimensions; 15 % are bad."""
    name, drop = case
    sampler, group = GROUPED[name]
    num = 47 if name == "threes" else 48
    theta, sigma = jnp.array([0.1, 0.2]), jnp.array([0.5, 0.4])

    def fun(x):
        out = 100 + jnp.sin(3 * x[0]) * x[1] + jnp.exp(x[0])
        return jnp.where(jnp.sin(40 * x[1]) > 0.9, jnp.nan, out) if drop else out

    options: dict[str, Any] = {"sampler": sampler, "num_samples": num}
    options["nonfinite"] = "drop" if drop else "propagate"

    @jax.jit
    def run():
        z, _ = sampler.draw(KEY, 0, num, num, 2, jnp.float64)
        f = jax.vmap(fun)(theta[None] + sigma[None] * z)
        return (
            z,
            f,
            [
                quadratic_model(fun, sigma, baseline=b, **options)(KEY, theta)
                for b, _ in REFITS.values()
            ],
        )

    z, f, found = run()
    assert np.isnan(f).any() == drop
    groups = None if group is None else np.arange(num) // group
    for (_, make), (value, grad, hessian) in zip(REFITS.values(), found, strict=True):
        want = refitted(make, np.asarray(z), np.asarray(f), groups)
        np.testing.assert_allclose(value, want[0], rtol=1e-10)
        np.testing.assert_allclose(grad * sigma, want[1], atol=1e-9)
        np.testing.assert_allclose(hessian * np.outer(sigma, sigma), want[2], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("baseline", ["linear", "gp", "mean"])
def test_where_there_are_no_others_nothing_is_subtracted(baseline, x64):
    """One pair alone, or one that is left when others are dropped: as without a baseline."""
    x = jnp.array([0.1, 0.2])
    fun = lambda x: boxes(x) + 10
    bad = lambda x: jnp.where(x[0] < 0.1, jnp.nan, fun(x))

    def run(name):
        estimate = lambda fun, **options: quadratic_model(fun, 0.4, baseline=name, **options)
        return (
            estimate(fun, num_samples=2, sampler=PAIRS)(KEY, x),
            estimate(fun, num_samples=1, sampler=sd.Gaussian())(KEY, x),
            estimate(bad, num_samples=2, sampler=PAIRS, nonfinite="drop")(KEY, x),
        )

    found, want = jax.jit(lambda: (run(baseline), run("none")))()
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(want))
    assert_same(found, want, np.float64, 10)


@pytest.mark.parametrize("baseline", ["linear", "quadratic", "gp"])
def test_up_to_half_of_the_samples_may_be_dropped(baseline):
    """Estimates stay finite and unbiased; with fewer than half left they are NaN."""
    fun = lambda x: jnp.sum(x) + boxes(x[:2])

    def run(key, share):
        bad = lambda x: jnp.where(jnp.sin(1e4 * x[2]) < share, jnp.nan, fun(x))
        x = jnp.array([0.1, 0.2, 0.3, 0.4])
        g = sd.smooth_grad(
            bad, 0.5, num_samples=24, sampler=sd.Gaussian(), baseline=baseline, nonfinite="drop"
        )
        return g(key, x)

    found = jax.jit(lambda keys: jax.lax.map(lambda k: run(k, -0.1), keys))(keys(200))
    kept = found[jnp.all(jnp.isfinite(found), axis=1)]
    assert len(kept) > 100
    assert jnp.max(jnp.abs(kept)) < 30
    assert_unbiased(kept[:, 3], jnp.array(1.0), resolution=0.1)
    assert jnp.all(jnp.isnan(jax.jit(run)(KEY, 0.9)))


# ---------------------------------------------------------------------------------------------
# standard errors


def corner(x):
    return jnp.all(x > 0).astype(x.dtype)


def smoothed_corner(x):
    return jnp.prod(jax.scipy.stats.norm.cdf(x / 0.5))


COVERAGE = {
    "linear": (sd.Gaussian(), "linear", 256, 256, 0.90, 0.98),
    "quadratic": (sd.Gaussian(), "quadratic", 256, 256, 0.90, 0.98),
    # its errors are about a tenth too small
    "gp": (sd.Gaussian(), "gp", 128, 128, 0.88, 0.96),
    "replicates": (sd.Sobol(replicates=8), "mean", 256, 8, 0.90, 0.97),
    "replicates, gp": (sd.Sobol(replicates=8), "gp", 256, 8, 0.90, 0.98),
    "one set": (sd.Sobol(), "mean", 256, 256, 0.97, 1.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", COVERAGE)
def test_standard_errors_cover(name):
    """Nominal 95 % t-intervals of value, gradient and a Hessian-vector product over 1,000 keys.

    Those of a single scrambled set are wider than they need be, never narrower.
    """
    sampler, baseline, num_samples, groups, low, high = COVERAGE[name]
    x, v = jnp.array([0.1, -0.2, 0.3]), jnp.array([1.0, -1.0, 0.5])

    def run(key):
        made = sd.smooth_quadratic(
            corner, 0.5, num_samples=num_samples, sampler=sampler, baseline=baseline
        )(key, x)
        found = made.value, made.grad, made.hessian.mv(v)
        return found, (*made.stderr, made.hessian_stderr(v))

    found, errors = jax.jit(lambda keys: jax.lax.map(run, keys))(keys(1000))
    product = jnp.matmul(jax.hessian(smoothed_corner)(x), v)
    exact = smoothed_corner(x), jax.grad(smoothed_corner)(x), product
    quantile = stats.t.ppf(0.975, groups - 1)
    covered = [
        np.mean(np.abs(a - np.asarray(c)[None]) <= quantile * np.asarray(b), axis=0)
        for a, b, c in zip(found, errors, exact, strict=True)
    ]
    # a proportion of a thousand has a standard error of 0.7 %
    for share in covered:
        assert np.all(share >= low - 0.01), covered
        assert np.all(share <= high + 0.01), covered
