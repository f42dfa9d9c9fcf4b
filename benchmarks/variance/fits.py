"""What a fitted baseline costs in time: a Gaussian process against the mean, on Box10.

All calls of one N run in turn, so that what else the machine does falls on all of them.
"""

import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

import smoothdiff as sd
from benchmarks.variance.measure import Case

SAMPLES = (64, 256, 1024, 4096)
BASELINES = ("mean", "gp")
TRANSFORMS: dict[str, Callable] = {"gradient": sd.smooth_grad, "hessian": sd.smooth_hessian}


def run(found: Case, samples: tuple[int, ...] = SAMPLES, turns: int = 20) -> list[dict[str, Any]]:
    """Median milliseconds of each call, and of evaluating alone at the same points."""
    return [_of(found, num, max(3, min(turns, turns * 1024 // num))) for num in samples]


def _of(found: Case, num: int, turns: int) -> dict[str, Any]:
    fun, sigma, sampler = found.problem.fun, found.problem.sigma, sd.Sobol()

    def evaluate(key: jax.Array, y: jax.Array) -> jax.Array:
        z, _ = sampler.draw(key, 0, num, num, y.size, y.dtype)
        return jax.vmap(lambda z: fun(y + sigma * z))(z)

    calls = {"evaluating alone": jax.jit(evaluate)}
    for quantity, transform in TRANSFORMS.items():
        for baseline in BASELINES:
            calls[f"{quantity}, {baseline}"] = jax.jit(
                transform(fun, sigma, num_samples=num, sampler=sampler, baseline=baseline)
            )
    seconds = {name: np.zeros(turns + 1) for name in calls}
    y = jax.numpy.asarray(found.positions[0])
    for i, key in enumerate(jax.random.split(jax.random.key(3), turns + 1)):
        for name, call in calls.items():
            began = time.perf_counter()
            jax.block_until_ready(call(key, y))
            seconds[name][i] = time.perf_counter() - began
    # the first turn compiles
    return {"samples": num, "ms": {n: 1e3 * np.median(s[1:]).item() for n, s in seconds.items()}}
