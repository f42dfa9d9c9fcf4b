"""How many samples a step should have: the supplement's Fig. 3.

All have the same evaluations to spend, so many samples a step mean few steps.
"""

from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from benchmarks._harness import Run, run
from benchmarks._style import COLOURS, figure
from benchmarks.zerograds import _show
from benchmarks.zerograds._configurations import configuration
from benchmarks.zerograds._setting import Setting, load

FLOOR = 1e-6  # the smallest error that is drawn


def measure(setting: Setting, folder: Path, fresh: bool) -> dict[str, Any]:
    """The errors at the end, by task and number of samples: quartiles over the starts."""
    found = {}
    for name, numbers in setting.samples.items():
        task = load(name, setting)
        methods = [
            configuration(f"samples-{num}", f"N = {num}", num_samples=num) for num in numbers
        ]
        ran = run(
            task,
            methods,
            setting.seeds,
            folder / "runs" / name,
            setting=setting.name,
            fresh=fresh,
        )
        runs = {num: ran[method] for num, method in zip(numbers, methods, strict=True)}
        assert all(isinstance(each, list) for each in runs.values())
        found[name] = compare(runs, task.budget.evaluations)  # type: ignore[arg-type]
    return {"starts": setting.seeds, "tasks": found}


def compare(runs: dict[int, list[Run]], budget: int) -> dict[str, Any]:
    """Lower quartile, median and upper quartile of the error for each number of samples."""
    final = [[run["image_error"][-1] for run in each] for each in runs.values()]
    return {
        "evaluations": budget,
        "samples": list(runs),
        "errors": np.quantile(final, [0.25, 0.5, 0.75], axis=1).T.tolist(),
    }


def tables(results: dict[str, Any]) -> Table:
    """The medians."""
    tasks = results["tasks"]
    numbers = sorted({num for task in tasks.values() for num in task["samples"]})
    shown = _show.table(
        "Error that is left, in %, by the number of samples in a step",
        f"Medians over {results['starts']} starts, after equally many evaluations.",
        "task",
        "evaluations",
        *(f"N = {num}" for num in numbers),
    )
    for name, task in tasks.items():
        medians = {num: e[1] for num, e in zip(task["samples"], task["errors"], strict=True)}
        cells = [_show.short(100 * medians[num]) if num in medians else "" for num in numbers]
        shown.add_row(name, str(task["evaluations"]), *cells)
    return shown


def draw(results: dict[str, Any], folder: Path) -> None:
    """The errors against the number of samples."""
    tasks = results["tasks"]
    with figure(folder / "samples.png", 1, len(tasks), (3.6 * len(tasks), 3)) as (_, axes):
        for axis, (name, task) in zip(axes[0], tasks.items(), strict=True):
            low, middle, high = 100 * np.maximum(np.array(task["errors"]).T, FLOOR)
            axis.plot(task["samples"], middle, marker="o", color=COLOURS[1])
            axis.fill_between(task["samples"], low, high, color=COLOURS[1], alpha=0.15, lw=0)
            axis.set(xscale="log", yscale="log", xlabel="Samples in a step")
            axis.set_xticks(task["samples"], [str(num) for num in task["samples"]])
            axis.xaxis.minorticks_off()
            axis.set_title(f"{name}: {task['evaluations']:,} evaluations")
        axes[0, 0].set_ylabel("Error that is left, %")
