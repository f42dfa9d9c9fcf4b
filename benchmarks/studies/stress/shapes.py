"""Plateaus, kinks, and curvature: stiff, curved, indefinite, singular, negative."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from jax.scipy.stats import norm
from jaxtyping import Array, Float

import smoothdiff as sd
from benchmarks.studies.stress._check import (
    Check,
    alike,
    derivatives,
    exact_derivatives,
    in_widths,
    precisions,
)

# functions of a number, and what they are after smoothing with width s
PLATEAUS: dict[str, tuple[Callable, Callable]] = {
    "step": (lambda x: jnp.where(x > 0, 1.0, 0.0), lambda x, s: ndtr(x / s)),
    "sign": (jnp.sign, lambda x, s: 2 * ndtr(x / s) - 1),
    "|x|": (jnp.abs, lambda x, s: x * (2 * ndtr(x / s) - 1) + 2 * s * norm.pdf(x / s)),
    "floor": (jnp.floor, lambda x, s: sum(ndtr((x - k) / s) for k in range(-9, 10)) - 10),
    "narrow box": (
        lambda x: jnp.where(jnp.abs(x) < 0.05, 1.0, 0.0),
        lambda x, s: ndtr((x + 0.05) / s) - ndtr((x - 0.05) / s),
    ),
}


def plateaus() -> Iterator[Check]:
    """Functions that are flat, broken or kinked: derivatives against closed forms, N = 256."""
    sigma = 0.3

    def fun(x: Float[Array, "1"], which: Array) -> Array:
        return jnp.stack([f(x[0]).astype(x.dtype) for f, _ in PLATEAUS.values()])[which]

    for dtype, _ in precisions():
        x, which = jnp.array([0.2], dtype), jnp.arange(len(PLATEAUS))
        g = derivatives(fun, sigma, num_samples=256)
        every = jax.jit(jax.vmap(g, in_axes=(None, None, 0)))(jax.random.key(0), x, which)
        for i, (what, (_, smoothed)) in enumerate(PLATEAUS.items()):
            exact = exact_derivatives(lambda x, smoothed=smoothed: smoothed(x[0], sigma))(x)
            found = {name: each[i] for name, each in every.items()}
            yield from alike(f"{what}, {dtype}", 0.05, found, exact)


def quadratic(x: Float[Array, " n"], matrix: Float[Array, "n n"]) -> Float[Array, ""]:
    """A quadratic form, whose Hessian is the matrix."""
    return jnp.vdot(x, jnp.matmul(matrix, x, precision="highest"), precision="highest") / 2


def stiff() -> Iterator[Check]:
    """Quadratics of condition 1e10 (float32: 1e5) in eight dimensions, N = 256.

    With a width for each parameter to match, errors are in units of the widths. With one width for
    a rotated form they are relative to the largest eigenvalue, and the smallest is looked at.
    """
    n, key = 8, jax.random.key(0)
    mixing = np.linalg.qr(np.random.default_rng(0).normal(size=(n, n)))[0]
    middle = mixing @ np.diag(np.linspace(1, 4, n)) @ mixing.T
    half = np.full(n, 0.5)
    options = {"baseline": "quadratic", "num_samples": 256}
    for dtype, limit in precisions(1e-4, 1e-11):
        condition, least = (1e5, 0.1) if dtype == "float32" else (1e10, 1e-4)
        spread = np.logspace(0, -0.5 * np.log10(condition), n)
        sigma, matrix = (jnp.asarray(x, dtype) for x in (spread, middle / np.outer(spread, spread)))
        found = jax.jit(derivatives(quadratic, sigma, **options))(key, sigma / 2, matrix)
        exact = {"gradient": middle @ half, "Hessian": middle}
        yield from alike(f"matched widths, {dtype}", limit, in_widths(found, spread), exact)

        rotated = mixing @ np.diag(spread**2) @ mixing.T
        place, matrix = jnp.asarray(half, dtype), jnp.asarray(rotated, dtype)
        found = jax.jit(derivatives(quadratic, 1.0, **options))(key, place, matrix)
        exact = {"gradient": rotated @ half, "Hessian": rotated}
        yield from alike(f"one width, {dtype}", limit, found, exact)
        smallest = np.linalg.eigvalsh(np.asarray(found["Hessian"], np.float64))[0]
        seen = abs(smallest * condition - 1)
        yield Check(f"smallest eigenvalue, {dtype}", "relative error", least, seen)


def rosenbrock(baselines: Sequence[str] = ("gp", "quadratic")) -> Iterator[Check]:
    """The curved valley at its usual start, at its bend and at its minimum, N = 256."""
    sigma = 0.1

    def fun(p: Float[Array, "2"]) -> Array:
        return (1 - p[0]) ** 2 + 100 * (p[1] - p[0] ** 2) ** 2

    def smoothed(p: Float[Array, "2"]) -> Array:
        a, b, s = p[0], p[1], sigma**2
        fourth = a**4 + 6 * a**2 * s + 3 * s**2
        return (1 - a) ** 2 + s + 100 * (b**2 + s - 2 * b * (a**2 + s) + fourth)

    for dtype, _ in precisions():
        places = jnp.array([[-1.2, 1.0], [0.0, 0.0], [1.0, 1.0]], dtype)
        exact = jax.vmap(exact_derivatives(smoothed))(places)
        for baseline in baselines:

            @jax.jit
            @jax.vmap
            def run(x, baseline=baseline):
                make = sd.smooth_quadratic(fun, sigma, baseline=baseline, num_samples=256)
                model = make(jax.random.key(0), x)
                columns = [model.hessian.stderr(unit) for unit in jnp.eye(2, dtype=x.dtype)]
                found = {"gradient": model.grad, "Hessian": model.hessian.as_matrix()}
                return found, {"gradient": model.stderr[1], "Hessian": jnp.stack(columns)}

            found, stderr = run(places)
            for name in exact:
                away = np.max(np.abs(found[name] - exact[name]) / stderr[name]).item()
                yield Check(f"{name}, {dtype}, {baseline}", "standard errors", 4.0, away)


def definiteness() -> Iterator[Check]:
    """Hessians that are indefinite, singular, negative or zero: all eigenvalues, N = 64."""
    matrices = {
        "indefinite": np.diag([1.0, -2.0, 3.0]),
        "singular": np.ones((3, 3)),
        "negative": -np.diag([1.0, 2.0, 3.0]),
        "zero": np.zeros((3, 3)),
    }
    g = derivatives(quadratic, 1.0, baseline="quadratic", num_samples=64)
    for dtype, limit in precisions(1e-4, 1e-11):
        stacked = jnp.asarray(np.stack(list(matrices.values())), dtype)
        place = jnp.array([0.3, -0.2, 0.1], dtype)
        found = jax.jit(jax.vmap(g, in_axes=(None, None, 0)))(jax.random.key(0), place, stacked)
        for what, hessian in zip(matrices, found["Hessian"], strict=True):
            away = np.linalg.eigvalsh(hessian) - np.linalg.eigvalsh(matrices[what])
            seen = np.max(np.abs(away)).item()
            yield Check(f"{what}, {dtype}", "off an eigenvalue", limit, seen)


def _negated_gaussian(dtype: str, **options: Any) -> tuple[np.ndarray, np.ndarray]:
    """Hessians at 200 places of (-3, 3)^2, found and exact: minus N(0, I) seen through N(0, I)."""
    height = 1 / (2 * np.pi)
    fun = lambda x: -height * jnp.exp(-jnp.sum(x * x) / 2)
    smoothed = lambda x: -height / 2 * jnp.exp(-jnp.sum(x * x) / 4)
    with jax.enable_x64(dtype == "float64"):
        places = jax.random.uniform(jax.random.key(1), (200, 2), dtype, minval=-3, maxval=3)
        g = sd.smooth_hessian(fun, 1.0, num_samples=100, **options)
        found = jax.jit(jax.vmap(g))(jax.random.split(jax.random.key(0), 200), places)
        return np.asarray(found), np.asarray(jax.vmap(jax.hessian(smoothed))(places))


def negated_gaussian() -> Iterator[Check]:
    """Minus a Gaussian, negative or indefinite almost everywhere: the default, N = 100."""
    published = sd.Aggregate(2, share=0.0)
    theirs, exact = _negated_gaussian("float32", sampler=published, baseline="none")
    ours, _ = _negated_gaussian("float32")
    seen = (np.mean(np.abs(ours - exact)) / np.mean(np.abs(theirs - exact))).item()
    yield Check("default", "times the published sampler's error", 0.2, seen)
    wrong = np.sign(np.linalg.eigvalsh(ours)) != np.sign(np.linalg.eigvalsh(exact))
    yield Check("default", "of eigenvalues with a wrong sign", 0.05, np.mean(wrong).item())


def appendix_h() -> Iterator[Check]:
    """The paper's mean error of 1e-4, N = 100. It states neither widths nor normalisation.

    Both widths are 1 here, and the Gaussian is normalised.
    """
    smooth = sd.GaussianProcess(ridge=1e-6)
    for what, dtype, options in (
        ("default", "float32", {}),
        ("GaussianProcess(ridge=1e-6)", "float64", {"baseline": smooth}),
    ):
        found, exact = _negated_gaussian(dtype, **options)
        seen = np.mean(np.abs(found - exact)).item()
        yield Check(f"{what}, {dtype}", "mean error of an entry", 1e-4, seen)
