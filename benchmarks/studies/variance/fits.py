"""What a fitted baseline costs in time: a Gaussian process against the mean, on Box10."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import smoothdiff as sd
from benchmarks._timing import in_turns
from benchmarks.studies.overhead import evaluating
from benchmarks.studies.variance.errors import Case

SAMPLES = (64, 256, 1024, 4096)
TURNS = 20  # fewer where a call takes long
QUANTITIES = {"gradient": sd.smooth_grad, "hessian": sd.smooth_hessian}


def run(found: Case, estimators: dict[str, Any]) -> list[dict[str, Any]]:
    """For each number of samples: times, and above what time of an evaluation a fit pays.

    Args:
        found: Box10.
        estimators: The errors there, of "sobol-mean" and of "sobol-gp".
    """
    lines = []
    for num in SAMPLES:
        ms = milliseconds(found, num, max(3, min(TURNS, TURNS * 1024 // num)))
        pays = {f"{q} pays from, us": pays_from(estimators, ms, num, q) for q in QUANTITIES}
        lines.append({"N": num} | ms | pays)
    return lines


def milliseconds(found: Case, num: int, turns: int) -> dict[str, float]:
    """Median of each call, and of evaluating alone at the same points."""
    fun, sigma, sampler = found.problem.fun, found.problem.sigma, sd.Sobol()
    transforms = {"evaluating alone": evaluating(fun, sigma, sampler, num)}
    for quantity, transform in QUANTITIES.items():
        for baseline in ("mean", "gp"):
            options: Any = {"num_samples": num, "sampler": sampler, "baseline": baseline}
            transforms[f"{quantity}, {baseline}"] = transform(fun, sigma, **options)
    y, keys = jnp.asarray(found.positions[0]), list(jax.random.split(jax.random.key(3), turns + 1))
    jitted = {name: jax.jit(call) for name, call in transforms.items()}
    calls = {name: lambda i, call=call: call(keys[i], y) for name, call in jitted.items()}
    return {name: 1e3 * np.median(s).item() for name, s in in_turns(calls, turns).items()}


def pays_from(
    estimators: dict[str, Any], ms: dict[str, float], num: int, quantity: str
) -> float | None:
    """Microseconds of an evaluation above which a Gaussian process is worth its time, or None.

    Without it the same error takes more evaluations; how many is read from the errors of the plain
    mean, as a power of their number.
    """
    plain, fitted = (estimators[name][quantity] for name in ("sobol-mean", "sobol-gp"))
    errors, used = ([at[key] for at in plain.values()] for key in ("rmse", "evaluations"))
    slope, level = np.polyfit(np.log(used), np.log(errors)[:, 1], 1)
    spared = np.exp((np.log(fitted[num]["rmse"][1]) - level) / slope) - num
    extra = ms[f"{quantity}, gp"] - ms[f"{quantity}, mean"]
    return 1e3 * max(float(extra / spared), 0.0) if spared > 0 else None
