"""Sobol points as one set or as several: what honest standard errors cost, and what they cover.

R sets scrambled on their own give R independent estimates, so an interval from Student's t with
R - 1 degrees of freedom. A single set has the formula for independent points, which is too wide.
"""

from typing import Any

import jax
import numpy as np

import smoothdiff as sd
from benchmarks.variance.measure import Case, Row, ratio, resampled

REPLICATES = (1, 4, 8)
BASELINES = ("mean", "gp")
SAMPLES = 256
LEVEL = 0.95


def run(found: Case, samples: int = SAMPLES) -> list[dict[str, Any]]:
    """For each number of sets and baseline: RMSE over that of one set, coverage, width."""
    from scipy.stats import t

    truth, repeats = found.truth["gradient"], len(found.positions)
    keys = jax.random.split(jax.random.key(2), repeats)
    results = []
    for baseline in BASELINES:
        single = None
        for sets in REPLICATES:
            grad = jax.jit(
                sd.smooth_grad(
                    found.problem.fun,
                    found.problem.sigma,
                    num_samples=samples,
                    sampler=sd.Sobol(replicates=sets),
                    baseline=baseline,
                    stderr=True,
                )
            )
            pairs = [grad(key, y) for key, y in zip(keys, found.positions, strict=True)]
            estimates, errors = (np.asarray(part, np.float64) for part in zip(*pairs, strict=True))
            freedom = sets - 1 if sets > 1 else samples - 1
            half = t.ppf((1 + LEVEL) / 2, freedom) * errors
            away = np.abs(estimates - truth)
            row = Row(samples, np.sum(away**2, axis=1), np.sum(truth**2, axis=1), np.zeros(repeats))
            single = row if single is None else single
            inside = (away <= half).mean(axis=1)
            results.append(
                {
                    "baseline": baseline,
                    "sets": sets,
                    "rmse_over_one_set": ratio(single, row).tolist(),
                    "coverage": resampled(lambda i, x=inside: x[i].mean(-1), repeats).tolist(),
                    "half_width_over_rmse": np.sqrt(np.mean(half**2) / np.mean(away**2)).item(),
                }
            )
    return results
