"""How many samples a step should have: the supplement's Fig. 3.

All have the same evaluations to spend, so many samples a step mean few steps.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._grid import Grid, Row, short
from benchmarks._summary import quarters
from benchmarks.studies.zerograds._runs import BUDGETS, configuration, curves, load, panels, ran

NUMBERS = {"led": (2, 4, 8, 16), "rocket10": (2, 4, 8, 16, 32)}
FLOOR = 1e-6  # the smallest error that is drawn


def measure(starts: int, folder: Path, fresh: bool) -> dict[str, Any]:
    """The errors at the end, by task and number of samples: quartiles over the starts."""
    tasks = {}
    for name, numbers in NUMBERS.items():
        methods = [configuration(f"samples-{number}", num_samples=number) for number in numbers]
        runs = ran(load(name), methods, starts, folder, fresh).values()
        errors = [quarters([run["image_error"][-1] for run in each]) for each in runs]
        tasks[name] = {"evaluations": BUDGETS[name], "samples": numbers, "errors": errors}
    return {"tasks": tasks}


def tables(results: dict[str, Any]) -> Iterator[Grid]:
    """The medians."""
    tasks = results["tasks"]
    numbers = sorted({number for task in tasks.values() for number in task["samples"]})
    rows = []
    for name, task in tasks.items():
        left = dict(zip(task["samples"], task["errors"], strict=True))
        cells = (short(100 * left[number][1]) if number in left else "" for number in numbers)
        rows.append(Row(name, (str(task["evaluations"]), *cells)))
    yield Grid(
        "Error that is left, in %, by the number of samples in a step",
        f"Medians over {results['starts']} starts, after equally many evaluations.",
        ("task", "evaluations", *(f"N = {number}" for number in numbers)),
        tuple(rows),
    )


def draw(results: dict[str, Any], path: Path) -> None:
    """The errors against the number of samples."""
    with panels(path, results["tasks"], "Samples in a step", "Error that is left") as axes:
        for axis, task in axes:
            curves(axis, task["samples"], {"Ours": np.transpose(task["errors"])}, FLOOR, marker="o")
            axis.set(xscale="log", yscale="log")
            axis.set_xticks(task["samples"], [str(number) for number in task["samples"]])
            axis.xaxis.minorticks_off()
