"""Sobol points as one set or as several: what honest standard errors cost, and what they cover.

R sets scrambled on their own give R independent estimates, so an interval from Student's t with
R - 1 degrees of freedom. A single set has the formula for independent points, which is too wide.
"""

from typing import Any

import jax
import numpy as np

import smoothdiff as sd
from benchmarks.studies.variance.errors import Case, Row, ratio, resampled

REPLICATES = (1, 4, 8)
BASELINES = ("mean", "gp")
SAMPLES = 256
LEVEL = 0.95


def run(found: Case) -> list[dict[str, Any]]:
    """For each number of sets and baseline: RMSE over that of one set, coverage, width."""
    from scipy.stats import t

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
            line = {"baseline": baseline, "sets": sets}
            line["RMSE over one set's"] = ratio(single, row).tolist()
            line["coverage"] = resampled(lambda i, x=inside: x[i].mean(-1), repeats).tolist()
            line["half width over RMSE"] = np.sqrt(np.mean(half**2) / np.mean(away**2)).item()
            lines.append(line)
    return lines
