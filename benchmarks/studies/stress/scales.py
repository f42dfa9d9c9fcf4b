"""Offsets and scales of the function, and widths from tiny to huge."""

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import smoothdiff as sd
from benchmarks.studies.stress._check import (
    BASELINES,
    Check,
    alike,
    derivatives,
    edge_and_waves,
    exact_derivatives,
    in_widths,
    precisions,
    relative,
    rms,
    smoothed_edge_and_waves,
)


class SinglePoints(sd.Sobol):
    """Sobol points of float32, also where the estimate is in float64."""

    def draw(self, key, start, count, num_samples, n, dtype):
        z, log_ratio = super().draw(key, start, count, num_samples, n, jnp.float32)
        return z.astype(dtype), log_ratio


def offset(
    baselines: Sequence[str] = ("mean", "center", "linear", "quadratic", "gp"), places: int = 16
) -> Iterator[Check]:
    """f + 1e6: in float64 it costs nothing to speak of, in float32 the rounding of f.

    What that rounding forces is what the same estimator in float64 makes of the rounded values.
    """
    single, offset = jnp.float32, 1e6

    def fun(x, offset, rounded):
        value = edge_and_waves(x.astype(single))
        far = (value + offset.astype(single)).astype(x.dtype)
        return jnp.where(rounded, far, value.astype(x.dtype) + offset)

    with jax.enable_x64(True):
        keys = jax.random.split(jax.random.key(0), places)
        thetas = 0.5 * jax.random.normal(jax.random.key(1), (places, 3), single)
        exact = jax.vmap(exact_derivatives(smoothed_edge_and_waves))(thetas.astype(jnp.float64))
        for baseline in baselines:
            options: Any = {"sampler": SinglePoints(), "num_samples": 256, "baseline": baseline}
            g = derivatives(fun, 1.0, **options)
            batched = jax.jit(jax.vmap(g, in_axes=(0, 0, None, None)))

            def run(dtype, offset, rounded, batched=batched):
                found = batched(keys, thetas.astype(dtype), jnp.array(offset, dtype), rounded)
                return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), found)

            plain, far = (run(jnp.float64, at, False) for at in (0.0, offset))
            forced, seen = (run(dtype, offset, True) for dtype in (jnp.float64, single))
            for name in exact:
                growth = rms(far[name] - exact[name]) / rms(plain[name] - exact[name])
                what = f"{name}, float64, {baseline}"
                yield Check(what, "times the error of f", 1.01, growth)
                growth = rms(seen[name] - plain[name]) / rms(forced[name] - plain[name])
                what = f"{name}, float32, {baseline}"
                yield Check(what, "times what rounding f forces", 3.0, growth)


def scale(baselines: Sequence[str] = BASELINES) -> Iterator[Check]:
    """1e-30 f and 1e30 f in float32: estimates and standard errors are in proportion."""
    x = jnp.array([0.1, 0.2, -0.4])
    for baseline in baselines:

        @jax.jit
        def run(size, baseline=baseline):
            make = sd.smooth_quadratic(
                lambda x: size * edge_and_waves(x), 1.0, baseline=baseline, num_samples=64
            )
            model = make(jax.random.key(0), x)
            products = model.hessian.mv(x), model.hessian_stderr(x)
            found = model.value, model.grad, model.stderr, products
            return jax.tree.map(lambda leaf: leaf / size, found)

        usual = run(1.0)
        for size in (1e-30, 1e30):
            seen = relative(run(size), usual)
            yield Check(f"{size:.0e}, {baseline}", "relative error", 1e-4, seen)


def width() -> Iterator[Check]:
    """Widths from 1e-6 to 1e3 around parameters of 1, and one that float32 cannot see."""
    for dtype, _ in precisions():
        theta, place = jnp.ones(2, dtype), jnp.array([0.3, -0.2], dtype)
        exact = exact_derivatives(smoothed_edge_and_waves)(place)

        @jax.jit
        def run(sigma, theta=theta, place=place):
            fun = lambda x: edge_and_waves((x - theta) / sigma + place)
            return derivatives(fun, sigma, num_samples=256)(jax.random.key(0), theta)

        usual = run(1.0)
        for sigma in (1e-6, 1e-3, 1e3):
            for name, found in in_widths(run(sigma), sigma).items():
                growth = rms(found - exact[name]) / rms(usual[name] - exact[name])
                what = f"{name}, {dtype}, sigma {sigma:g}"
                yield Check(what, "times the error at sigma 1", 1.1, growth)
    yield from invisible()


def invisible() -> Iterator[Check]:
    """A width that float32 cannot see is an error, or NaN where it is traced."""
    g = sd.smooth_grad(edge_and_waves, 1e-8)
    key, theta = jax.random.key(0), jnp.ones(2)
    try:
        g(key, theta)
        answered = True
    except ValueError as error:
        answered = "spacing" not in str(error)
    yield Check("float32, sigma 1e-8", "answers without an error", 0, float(answered))
    numbers = jnp.sum(jnp.isfinite(jax.jit(g)(key, theta))).item()
    yield Check("float32, sigma 1e-8, traced", "answers that are no NaN", 0, numbers)


def decades(baselines: Sequence[str] = BASELINES) -> Iterator[Check]:
    """Nine parameters with widths from 1e-4 to 1e4: as if all were in units of their width."""
    for dtype, limit in precisions(1e-4, 1e-11):
        place = jnp.linspace(-0.5, 0.6, 9, dtype=dtype)

        @partial(jax.jit, static_argnums=0)
        def run(baseline, sigma, place=place):
            fun = lambda x: edge_and_waves(x / sigma)
            g = derivatives(fun, sigma, baseline=baseline, num_samples=256)
            return g(jax.random.key(0), place * sigma)

        even, spread = jnp.ones(9, dtype), jnp.logspace(-4, 4, 9, dtype=dtype)
        for baseline in baselines:
            found, usual = (in_widths(run(baseline, each), each) for each in (spread, even))
            yield from alike(f"{dtype}, {baseline}", limit, found, usual)
