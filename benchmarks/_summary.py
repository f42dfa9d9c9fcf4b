"""From runs to numbers: what each method took from each start, and curves with their spread.

Errors are relative to those of the start. A level of 99 % is reached at the first point of a run
whose error is at most 1 % of the start's. Where the lowest value of the loss is known, there is
also the gap to it, which is absolute. A run that never gets to a level took infinitely long, so a
median is infinite when half of the runs do not get there.
"""

import math
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from benchmarks._loop import CLOSED, Run, Runs
from benchmarks._study import rounded
from benchmarks._task import NotAble, Task

REDUCTIONS = {"90": 0.1, "99": 0.01, "99.9": 0.001}  # in percent
GAPS = {"1e0": 1.0, "1e-3": 1e-3, "1e-8": CLOSED}
LEVELS = {"image_error": REDUCTIONS, "parameter_error": REDUCTIONS, "gap": GAPS}
COSTS = ("evaluations", "seconds")
POINTS = 40  # of a curve
UNKNOWN = "a machine that was not recorded"
DIGITS = 3  # of a number in a curve: a line in a picture needs no more


def summarise(task: Task, runs: Runs) -> dict[str, Any]:
    """What results.json says of a task."""
    return {
        "title": task.title,
        "notes": task.notes,
        "budget": task.problem.budget._asdict(),
        "sigma": task.problem.sigma,
        "dimensions": sum(np.size(leaf) for leaf in jax.tree.leaves(task.problem.like)),
        "methods": {
            method.name: {"title": method.title}
            | ({"not_able": str(found)} if isinstance(found, NotAble) else of_runs(found))
            for method, found in runs.items()
        },
    }


def of_runs(runs: list[Run]) -> dict[str, Any]:
    """What the runs of one method took and left, as quartiles over the starts, and their curves."""
    errors = [error for error in LEVELS if error in runs[0]]
    return {
        "starts": len(runs),
        "machines": sorted({run.get("machine", UNKNOWN) for run in runs}),
        "commits": sorted({run.get("commit", "") for run in runs} - {""}),
        "warm_up_seconds": runs[0]["warm_up_seconds"],
        "distance": quartiles([run["distance"] for run in runs]),
        "first": float(runs[0]["image_error"][-1]),  # what the first start, which is pictured, left
        "final": {error: quartiles([float(run[error][-1]) for run in runs]) for error in errors},
        "took": {
            error: {name: took(runs, error, level) for name, level in LEVELS[error].items()}
            for error in errors
        },
        "curves": {error: {cost: curve(runs, error, cost) for cost in COSTS} for error in errors},
    }


def took(runs: list[Run], error: str, level: float) -> dict[str, Any]:
    """From how many starts a level is reached, and quartiles of what that costs."""
    costs = {cost: [cost_to_level(run[error], run[cost], level) for run in runs] for cost in COSTS}
    solved = sum(math.isfinite(cost) for cost in costs["evaluations"])
    found = {cost: quartiles(values) | without_one(values) for cost, values in costs.items()}
    return {"solved": solved} | found


def curve(runs: list[Run], error: str, cost: str) -> dict[str, Any]:
    """Quartiles of an error at costs that are even in the logarithm; none of a run of one point."""
    costs = np.concatenate([run[cost] for run in runs])
    if not costs.any():  # it gave up at once
        return {"ends": None, "quartiles": []}
    ends = float(costs[costs > 0].min()), float(costs.max())
    found = band(runs, error, cost, grid(ends))
    return {"ends": ends, "quartiles": rounded(found, DIGITS)}


def grid(ends: Sequence[float]) -> np.ndarray:
    """The costs of the points of a curve between its ends."""
    return np.geomspace(ends[0], ends[1], POINTS)


def cost_to_level(errors: Sequence[float], costs: Sequence[float], level: float) -> float:
    """The cost at which the error is first at most `level`; infinite if it never is."""
    found = (float(c) for e, c in zip(errors, costs, strict=True) if e <= level)
    return next(found, math.inf)


def quartiles(values: Sequence[float]) -> dict[str, float | None]:
    """Median, lower and upper quartile; None stands for infinity, which JSON lacks.

    By name: in a list the first is easily taken for the median.
    """
    # "higher" takes values as they are: between a number and infinity there is no mean
    three = np.quantile(values, [0.5, 0.25, 0.75], method="higher")
    found = [float(q) if math.isfinite(q) else None for q in three]
    return dict(zip(("median", "lower", "upper"), found, strict=True))


def without_one(values: Sequence[float]) -> dict[str, float | None]:
    """The least and the most that the median is when any one of the values is left out."""
    if len(values) < 2:
        return {}
    left = (quartiles([*values[:i], *values[i + 1 :]])["median"] for i in range(len(values)))
    medians = sorted(math.inf if median is None else median for median in left)
    ends = zip(("least", "most"), (medians[0], medians[-1]), strict=True)
    return {name: value if math.isfinite(value) else None for name, value in ends}


def quarters(values: Any) -> list[Any]:
    """Lower quartile, median and upper quartile over the first axis, with means between values."""
    with np.errstate(invalid="ignore"):  # between infinities the mean is NaN, which is no number
        return np.quantile(values, [0.25, 0.5, 0.75], axis=0).tolist()


def band(runs: list[Run], error: str, cost: str, costs: Any) -> list[list[float]]:
    """Quarters of the error over the runs, at each of the costs, (3, costs)."""
    errors, costs = [], np.asarray(costs)
    for run in runs:
        # a run stays where it stopped
        last = np.searchsorted(run[cost], costs * (1 + 1e-9), side="right") - 1
        errors.append(np.asarray(run[error])[last])
    return quarters(errors)


def able(task: dict[str, Any]) -> dict[str, Any]:
    """The methods that ran on a task, by its results."""
    return {name: found for name, found in task["methods"].items() if "took" in found}
