"""What standard errors and fitted baselines cost, on Box10.

R sets of Sobol points scrambled on their own give R independent estimates, so an interval from
Student's t with R - 1 degrees of freedom. A single set has the formula for independent points,
which is too wide.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import smoothdiff as sd
from benchmarks._timing import compiled
from benchmarks.studies.overhead import evaluating
from benchmarks.studies.variance.errors import Case, Row, ratio, resampled

BASELINES = ("mean", "gp")
REPLICATES = (1, 4, 8)
SAMPLES = 256  # of the sets together
LEVEL = 0.95
TIMED = (64, 256, 1024, 4096)  # samples
TURNS = 20  # fewer where a call takes long
QUANTITIES = {"gradient": sd.smooth_grad, "hessian": sd.smooth_hessian}


def replicates(found: Case) -> list[dict[str, Any]]:
    """For each number of sets and baseline: RMSE over that of one set, coverage, width."""
    from scipy.stats import t  # it takes long to import

    truth, repeats = found.truth["gradient"], len(found.positions)
    fun, sigma = found.problem.fun, found.problem.sigma
    keys = jax.random.split(jax.random.key(2), repeats)
    lines = []
    for baseline in BASELINES:
        single = None
        for sets in REPLICATES:
            options: Any = {"num_samples": SAMPLES, "baseline": baseline, "stderr": True}
            grad = jax.jit(sd.smooth_grad(fun, sigma, sampler=sd.Sobol(replicates=sets), **options))
            pairs = [grad(key, y) for key, y in zip(keys, found.positions, strict=True)]
            estimates, errors = (np.asarray(part, np.float64) for part in zip(*pairs, strict=True))
            half = t.ppf((1 + LEVEL) / 2, sets - 1 if sets > 1 else SAMPLES - 1) * errors
            away = np.abs(estimates - truth)
            row = Row(SAMPLES, np.sum(away**2, axis=1), np.sum(truth**2, axis=1), np.zeros(repeats))
            single = single or row
            inside = (away <= half).mean(axis=1)
            lines.append(
                {
                    "baseline": baseline,
                    "sets": sets,
                    "RMSE over one set's": ratio(single, row).tolist(),
                    "coverage": resampled(lambda i, x=inside: x[i].mean(-1), repeats).tolist(),
                    "half width over RMSE": np.sqrt(np.mean(half**2) / np.mean(away**2)).item(),
                }
            )
    return lines


def fits(found: Case, estimators: dict[str, Any]) -> list[dict[str, Any]]:
    """For each number of samples: times, and above what time of an evaluation a fit pays.

    It takes the errors there, of the estimators "sobol-mean" and "sobol-gp".
    """
    lines = []
    for num in TIMED:
        ms = milliseconds(found, num, max(3, min(TURNS, TURNS * 1024 // num)))
        pays = {f"{q} pays from, us": pays_from(estimators, ms, num, q) for q in QUANTITIES}
        lines.append({"N": num} | ms | pays)
    return lines


def milliseconds(found: Case, num: int, turns: int) -> dict[str, float]:
    """Median of each call, and of evaluating alone at the same points."""
    fun, sigma, sampler = found.problem.fun, found.problem.sigma, sd.Sobol()
    transforms = {"evaluating alone": evaluating(fun, sigma, sampler, num)}
    for quantity, transform in QUANTITIES.items():
        for baseline in BASELINES:
            options: Any = {"num_samples": num, "sampler": sampler, "baseline": baseline}
            transforms[f"{quantity}, {baseline}"] = transform(fun, sigma, **options)
    y, keys = jnp.asarray(found.positions[0]), list(jax.random.split(jax.random.key(3), turns + 1))
    seconds = compiled(transforms, lambda i: (keys[i], y), turns)
    return {name: 1e3 * np.median(each).item() for name, each in seconds.items()}


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
