"""From runs to numbers: medians and quartiles over the starts, of errors and of what they took.

Errors are relative to those of the start. A level of 99 % is reached at the first point of a run
whose error is at most 1 % of the start's. Where the lowest value of the loss is known, there is
also the gap to it, which is absolute. A run that never gets to a level took infinitely long, so a
median is infinite when half of the runs do not get there.
"""

import math
import os
import platform
from collections.abc import Sequence
from importlib import metadata
from typing import Any

import jax
import numpy as np

from benchmarks._harness import CLOSED, Run
from benchmarks._task import Method, NotAble, Task

REDUCTIONS = {"90": 0.1, "99": 0.01, "99.9": 0.001}  # in percent
GAPS = {"1e0": 1.0, "1e-3": 1e-3, "1e-8": CLOSED}
LEVELS = {"image_error": REDUCTIONS, "parameter_error": REDUCTIONS, "gap": GAPS}
COSTS = ("evaluations", "seconds")
PACKAGES = (
    *("smoothdiff", "jax", "jaxlib", "optax", "optimistix", "equinox", "lineax", "numpy", "scipy"),
    *("mitsuba", "coco-experiment", "cma", "evosax", "jaxopt", "Py-BOBYQA", "pygad"),
)


def summarise(
    task: Task, runs: dict[Method, list[Run] | NotAble], setting: str, command: str
) -> dict[str, Any]:
    """What is written to results.json."""
    return {
        "task": task.name,
        "title": task.title,
        "setting": setting,
        "notes": task.notes,
        "budget": task.budget._asdict(),
        "sigma": task.sigma,
        "dimensions": sum(np.size(leaf) for leaf in jax.tree.leaves(task.reference)),
        "command": command,
        "machine": machine(),
        "methods": {
            method.name: {"title": method.title}
            | ({"not_able": str(found)} if isinstance(found, NotAble) else _of_method(found))
            for method, found in runs.items()
        },
    }


def _of_method(runs: list[Run]) -> dict[str, Any]:
    return {
        "starts": len(runs),
        "warm_up_seconds": runs[0]["warm_up_seconds"],
        "distance": quartiles([run["distance"] for run in runs]),
        **{
            error: {
                "final": quartiles([run[error][-1] for run in runs]),
                "levels": {
                    name: _level(runs, error, level) for name, level in LEVELS[error].items()
                },
            }
            for error in LEVELS
            if error in runs[0]
        },
        "runs": [{k: v for k, v in run.items() if k != "fingerprint"} for run in runs],
    }


def _level(runs: list[Run], error: str, level: float) -> dict[str, Any]:
    costs = {cost: [cost_to_level(run[error], run[cost], level) for run in runs] for cost in COSTS}
    solved = sum(math.isfinite(cost) for cost in costs["evaluations"])
    return {"solved": solved} | {cost: quartiles(values) for cost, values in costs.items()}


def cost_to_level(errors: Sequence[float], costs: Sequence[float], level: float) -> float:
    """The cost at which the error is first at most `level`; infinite if it never is."""
    return next((c for e, c in zip(errors, costs, strict=True) if e <= level), math.inf)


def quartiles(values: Sequence[float]) -> dict[str, float | None]:
    """Median, lower and upper quartile; None stands for infinity, which JSON lacks.

    By name: in a list the first is easily taken for the median.
    """
    # "higher" takes values as they are: between a number and infinity there is no mean
    three = np.quantile(values, [0.5, 0.25, 0.75], method="higher")
    found = [float(q) if math.isfinite(q) else None for q in three]
    return dict(zip(("median", "lower", "upper"), found, strict=True))


def band(runs: list[Run], error: str, cost: str, grid: np.ndarray) -> np.ndarray:
    """Quartiles of the error over the runs, at each cost of the grid, (3, grid)."""
    errors = []
    for run in runs:
        last = np.searchsorted(run[cost], grid, side="right") - 1  # a run stays where it stopped
        errors.append(np.asarray(run[error])[last])
    return np.quantile(errors, [0.25, 0.5, 0.75], axis=0)


def machine() -> dict[str, Any]:
    """Where the numbers come from."""
    versions = {}
    for package in PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return {
        "platform": platform.platform(),
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "versions": versions,
    }


def _cpu() -> str:
    try:
        with open("/proc/cpuinfo") as lines:
            return next(line.split(":")[1].strip() for line in lines if "model name" in line)
    except (OSError, StopIteration):
        return platform.processor()
