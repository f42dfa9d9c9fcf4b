"""Samples that are lost, and weights in high dimension."""

from collections.abc import Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np

import smoothdiff as sd
from benchmarks.studies.stress._check import (
    Check,
    derivatives,
    edge_and_waves,
    exact_derivatives,
    rms,
    smoothed_edge_and_waves,
)


def holes(
    baselines: Sequence[str] = ("none", "mean", "center", "linear", "quadratic", "gp"),
) -> Iterator[Check]:
    """NaN in 10 % of the samples, dropped: the errors of 256 independent ones, none lost."""

    def faulty(x, broken):
        # no pattern that an estimate could see: later digits of a coordinate decide
        unlucky = (1e3 * jnp.abs(x[0]) + 0.5) % 1 < 0.1
        return jnp.where(broken & unlucky, jnp.nan, edge_and_waves(x))

    keys = jax.random.split(jax.random.key(0), 64)
    place = jnp.array([0.3, -0.2, 0.1])
    exact = jax.device_get(exact_derivatives(smoothed_edge_and_waves)(place))
    for baseline in baselines:

        def errors(sampler, broken, baseline=baseline):
            options = {"sampler": sampler, "baseline": baseline, "nonfinite": "drop"}
            g = derivatives(faulty, 1.0, num_samples=256 + (baseline == "center"), **options)
            found = jax.jit(jax.vmap(g, in_axes=(0, None, None)))(keys, place, broken)
            return {name: rms(np.asarray(found[name]) - exact[name]) for name in exact}

        whole = errors(sd.Gaussian(), False)
        for sampler in (sd.Gaussian(), sd.Sobol()):
            dropped = errors(sampler, True)
            for name in exact:
                what = f"{name}, {type(sampler).__name__}, {baseline}"
                yield Check(what, "times the error", 1.2, dropped[name] / whole[name])


def log_weights(sizes: Sequence[int] = (1, 10_000, 50_000)) -> Iterator[Check]:
    """The aggregate sampler's weights: they stay in range, average 1, and spare no dimension."""
    for n in sizes:
        num = min(1024, 4_000_000 // n)
        for order in (1, 2):
            sampler = sd.Aggregate(order, antithetic=False)
            key = jax.random.key(0)
            draw = jax.jit(lambda key: sampler.draw(key, 0, num, num, n, jnp.float32))  # noqa: B023
            log_w = np.asarray(draw(key)[1], np.float64)
            what = f"order {order}, n = {n:,}"
            yield Check(what, "largest |log w|", 10.0, np.max(np.abs(log_w)).item())
            w = np.exp(log_w)
            away = abs(np.mean(w) - 1) / (np.std(w, ddof=1) / np.sqrt(num))
            yield Check(what, "standard errors of the mean off 1", 4.0, away)
            if n > 8:
                yield Check(what, "standard errors of evenness", 4.0, _unevenness(sampler, key, n))


def _unevenness(sampler: sd.Aggregate, key: jax.Array, n: int) -> float:
    """How far the chosen dimensions are from falling alike on all remainders by 8."""
    num = 1_000_000 // n
    chooses = jax.random.uniform(key, (num, sampler.uniforms(n) - n))
    # where all others are the Gaussian's 0.67, the chosen dimensions stand out
    u = jnp.concatenate([jnp.full((num, n), 0.75), chooses], axis=1)
    z, _ = sampler.points(u, n)
    chosen = np.nonzero(np.asarray(jnp.abs(z - z.min()) > 1e-3))[1]
    counts = np.bincount(chosen % 8, minlength=8)
    mean = chosen.size / 8
    return float(np.max(np.abs(counts - mean)) / np.sqrt(mean))
