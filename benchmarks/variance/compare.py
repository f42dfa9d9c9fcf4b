"""Who is how much more accurate than whom: against targets, and what each ingredient gives."""

from typing import Any, TypeAlias

import numpy as np

from benchmarks.variance.estimators import FAIRER, OURS, PEER, PUBLISHED
from benchmarks.variance.measure import Row, ratio, relative_rmse

Measured: TypeAlias = dict[str, dict[str, dict[int, dict[str, Row]]]]

# the RMSE of the published sampler over ours, (problem, quantity) -> {samples: at least}
TARGETS: dict[tuple[str, str], dict[int, float]] = {
    ("box2", "gradient"): {64: 3, 256: 5, 1024: 10},
    ("box10", "gradient"): {64: 2, 256: 3, 1024: 5},
    ("box2", "hessian"): {64: 15, 256: 25, 1024: 45},
    ("box10", "hessian"): {64: 15, 256: 20, 1024: 23},
}
# the same for fairer opponents: (opponent, problem, quantity, samples) -> at least
OTHER_TARGETS: dict[tuple[str, str, str, int], float] = {
    (FAIRER, "box2", "hessian", 1024): 5,
    (FAIRER, "box10", "hessian", 1024): 2,
    (PEER, "box2", "gradient", 1024): 5,
    (PEER, "box10", "gradient", 1024): 5,
    (PEER, "box2", "hessian", 1024): 4,
    (PEER, "box10", "hessian", 1024): 4,
}
OPPONENTS = (PUBLISHED, FAIRER, PEER)


def against_targets(measured: Measured) -> list[dict[str, Any]]:
    """For each target: the RMSE of each opponent over ours, with its interval."""
    out = []
    for (problem, quantity), by_samples in TARGETS.items():
        for num, target in by_samples.items():
            found = measured.get(problem, {})
            if not all(num in found.get(name, {}) for name in (OURS, *OPPONENTS)):
                continue
            ours = found[OURS][num][quantity]
            over = {}
            for name in OPPONENTS:
                least = OTHER_TARGETS.get((name, problem, quantity, num))
                over[name] = {
                    "ratio": ratio(ours, found[name][num][quantity]).tolist(),
                    "target": target if name == PUBLISHED else least,
                }
            out.append({"problem": problem, "quantity": quantity, "samples": num, "over": over})
    return out


def ingredients(measured: Measured) -> dict[str, Any]:
    """RMSE of the published sampler over that of each estimator, at equal evaluations.

    problem -> estimator -> quantity -> samples -> ratio. Where an estimator cannot make as many
    evaluations, errors count as if they fell with the root of their number.
    """
    out: dict[str, Any] = {}
    for problem, found in measured.items():
        for name, by_num in found.items() if PUBLISHED in found else ():
            for num, row_of in by_num.items():
                for quantity, row in row_of.items():
                    theirs = found[PUBLISHED][num][quantity]
                    fair = np.sqrt(theirs.evaluations / row.evaluations)
                    factor = fair * relative_rmse(theirs)[1] / relative_rmse(row)[1]
                    place = (
                        out.setdefault(problem, {}).setdefault(name, {}).setdefault(quantity, {})
                    )
                    place[num] = float(factor)
    return out


def pays_from_us(found: dict[str, dict[int, dict[str, Row]]], fit: dict[str, Any]) -> dict:
    """Microseconds of an evaluation above which a Gaussian process is worth its time, or None.

    Without it the same error takes more evaluations; how many is read from the errors of the plain
    mean, as a power of their number.
    """
    out = {}
    for quantity in ("gradient", "hessian"):
        rows = [row_of[quantity] for row_of in found["sobol-mean"].values()]
        errors = np.log([relative_rmse(row)[1] for row in rows])
        slope, level = np.polyfit(np.log([row.evaluations for row in rows]), errors, 1)
        fitted = relative_rmse(found["sobol-gp"][fit["samples"]][quantity])[1]
        spared = np.exp((np.log(fitted) - level) / slope) - fit["samples"]
        extra = fit["ms"][f"{quantity}, gp"] - fit["ms"][f"{quantity}, mean"]
        out[quantity] = 1e3 * max(float(extra / spared), 0.0) if spared > 0 else None
    return out
