"""Table 2: how far the ablations are behind where ours has taken 95 % of the error away.

The paper compares after equal iterations; here it is after equal evaluations, as finite differences
have a step for hundreds of ours. Errors below a thousandth of the start's count as that: a program
of switches is often solved exactly, and nothing can be divided by zero. Where ours does not get to
95 % the end of the budget is what counts. An ablation is ours with one setting changed.
"""

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import _registry
from benchmarks._grid import Grid, Row, short
from benchmarks._loop import Run
from benchmarks._task import Method
from benchmarks.studies.zerograds._runs import (
    BUDGETS,
    about,
    configuration,
    curves,
    errors,
    load,
    panels,
    ran,
    sized,
)
from smoothdiff import surrogates

CHANGES: dict[str, dict[str, Any]] = {
    "ours": {},
    "no-smooth": {"inner_sigma": 0.0},
    "no-nn": {"surrogate": surrogates.Quadratic},
    "no-local": {"local": False},
}
PAPER = {  # how many times larger than ours an error is, by its Table 2
    "rendering": {"no-smooth": 1.2, "no-nn": 8.9, "no-local": 12.3, "fd": 24.5, "fr22": 11.0},
    "modelling": {"no-smooth": 3.9, "no-nn": 792.4, "no-local": 613.4, "fd": 654.3, "fr22": 323.6},
    "animation": {"no-smooth": 1.5, "no-nn": 16.3, "no-local": 22.4, "fd": 10.2, "fr22": 3.3},
}
REACHED = 0.05  # of the error of the start
FLOOR = 1e-3  # of the error of the start


def methods() -> list[Method]:
    """The rows of Table 2, ours first."""
    fd = _registry.method("finite_differences")._replace(name="fd")
    changed = (configuration(name, **changes) for name, changes in CHANGES.items())
    return [*changed, fd, _registry.method("fr22")]


def measure(starts: int, folder: Path, fresh: bool) -> dict[str, Any]:
    """Curves and ratios of each task."""
    tasks = {}
    for name in BUDGETS:
        task = load(name)
        runs = ran(task, methods(), starts, folder, fresh)
        tasks[name] = compare(runs, about(task))
    return {"tasks": tasks}


def compare(runs: dict[str, list[Run]], task: dict[str, Any]) -> dict[str, Any]:
    """Each method's curve and its error over ours, where the median of ours is first at 5 %."""
    points = np.unique(np.concatenate([run["evaluations"] for run in runs["ours"]])).tolist()
    medians = errors(runs["ours"], points)[1]
    down = [at for at, error in zip(points, medians, strict=True) if error <= REACHED]
    at = down[0] if down else task["evaluations"][-1]
    there = {name: errors(each, [at])[1][0] for name, each in runs.items()}
    ours = max(there["ours"], FLOOR)
    left = {name: [run["image_error"][-1] for run in each] for name, each in runs.items()}
    return task | {
        "at": at,
        "reached": bool(down),
        "ratios": {name: max(each, FLOOR) / ours for name, each in there.items()},
        "final": {name: float(np.median(each)) for name, each in left.items()},
        "curves": {name: errors(each, task["evaluations"]) for name, each in runs.items()},
    }


def table(results: dict[str, Any]) -> Grid:
    """The ratios of the tasks beside those of the paper."""
    tasks = results["tasks"]
    names = next(iter(tasks.values()))["curves"]
    at = (f"{task['at']}{'' if task['reached'] else '*'}" for task in tasks.values())
    rows = [Row("evaluations", (*at, *("" for _ in PAPER)), end=True)]
    for name in names:
        found = [(task["ratios"][name], 100 * task["final"][name]) for task in tasks.values()]
        cells = (f"{short(ratio)} ({short(left)})" for ratio, left in found)
        rows.append(Row(name, (*cells, *(short(of.get(name, 1)) for of in PAPER.values()))))
    return Grid(
        "Error over that of ours, where ours has taken 95 % of it away (at the end, in %)",
        f"Medians over {results['starts']} starts. * ours does not get to 95 %: at the end of the "
        "budget. The paper's are means over groups of other scenes.",
        ("method", *tasks, *(f"paper: {group}" for group in PAPER)),
        tuple(rows),
    )


def draw(results: dict[str, Any], path: Path) -> None:
    """The curves of each task; a dotted line where the errors are compared."""
    shown = sized(results["tasks"])
    with panels(path, shown, "Evaluations", "Image error", abreast=3) as axes:
        for axis, task in axes:
            curves(axis, task["evaluations"], task["curves"], FLOOR)
            axis.axvline(task["at"], color="0.4", lw=0.8, ls=":")
            axis.axhline(REACHED, color="0.4", lw=0.8, ls=":")
            axis.set(xscale="log", yscale="log", ylim=(FLOOR / 1.3, 3))
