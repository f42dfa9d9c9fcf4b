"""How far estimates of derivatives are from the truth, for their evaluations and for their time.

Samplers and baselines, the papers' estimators and `optax.perturbations` estimate gradients,
Hessians and Hessian-vector products at random positions, where the truth is known in closed form.
The comparison is that of appendix J of Stochastic Gradient Estimation for Higher-order
Differentiable Rendering, with more estimators.
"""

from argparse import Namespace
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.studies.variance import costs, descent, targets
from benchmarks.studies.variance.errors import Case, Row, case, relative_rmse, rows
from benchmarks.studies.variance.estimators import ANYWHERE, ESTIMATORS, Estimator
from benchmarks.studies.variance.pictures import draw
from benchmarks.studies.variance.tables import tables

HELP = "errors of derivatives, for what they cost"
OPTIONS = ("full", "fresh")
QUICK = {"box2": 24, "box10": 24}  # positions
FULL = {"box2": 60, "box10": 60, "texture": 24}
SAMPLES = (16, 64, 256, 1024)
FULL_SAMPLES = (8, *SAMPLES, 4096)


def measure(options: Namespace, folder: Path) -> dict[str, Any]:
    """All errors, and with `full` also what standard errors and fits cost."""
    repeats, samples = (FULL, FULL_SAMPLES) if options.full else (QUICK, SAMPLES)
    measured, problems = {}, {}
    for name, number in repeats.items():
        estimators = ESTIMATORS[name] if options.full else ANYWHERE
        found = case(name, number)
        each = _rows(found, estimators, samples, folder / "runs" / name, options.fresh)
        measured[name] = each
        problems[name] = {
            "title": found.problem.title,
            "repeats": number,
            "estimators": {
                estimator: {"title": estimators[estimator].title}
                | {quantity: _curve(by_num) for quantity, by_num in by_quantity.items()}
                for estimator, by_quantity in each.items()
            },
        }
    results = {
        "problems": problems,
        "targets": targets.against_targets(measured),
        "descent": descent.run(),
    }
    if options.full:
        box10 = case("box10", repeats["box10"])
        results["replicates"] = costs.replicates(box10)
        results["fits"] = costs.fits(box10, problems["box10"]["estimators"])
    return results


def _rows(
    found: Case,
    estimators: Mapping[str, Estimator],
    samples: Sequence[int],
    folder: Path,
    fresh: bool,
) -> targets.Rows:
    """By estimator, quantity and number of samples; what has been measured is kept."""
    measured: targets.Rows = {}
    todo = list(product(estimators, samples))
    for name, num in tqdm(todo, desc=found.problem.name, unit="row"):
        path = folder / f"{name}-{num}-{len(found.positions)}.npz"
        for quantity, row in rows(found, estimators[name], num, path, fresh).items():
            measured.setdefault(name, {}).setdefault(quantity, {})[num] = row
    return measured


def _curve(by_num: dict[int, Row]) -> dict[int, dict[str, Any]]:
    """Evaluations, relative RMSE with its interval, and median milliseconds."""
    return {
        num: {
            "evaluations": row.evaluations,
            "rmse": relative_rmse(row).tolist(),
            "ms": 1e3 * np.median(row.seconds).item(),
        }
        for num, row in by_num.items()
    }


__all__ = ["HELP", "OPTIONS", "draw", "measure", "tables"]
