"""What it is worth that earlier batches are seen again, which the paper does not do.

Ours with 100 batches and with none, all else as it is for a task of its size: with up to 50
parameters the former is the default, beyond it the latter.
"""

from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from benchmarks._harness import Run, run
from benchmarks._style import COLOURS, figure
from benchmarks._summary import band, cost_to_level, quartiles
from benchmarks.zerograds import _show
from benchmarks.zerograds._configurations import configuration, size
from benchmarks.zerograds._setting import Setting, load

BATCHES = (100, 0)
TITLES = {"100": "100 batches seen again", "0": "none"}
LEVEL = 0.1  # of the error of the start, where evaluations are read
FLOOR = 1e-3  # the smallest error that is drawn
POINTS = 80  # of a curve


def measure(setting: Setting, folder: Path, fresh: bool) -> dict[str, Any]:
    """Curves, evaluations to the level and errors at the end, by task and number of batches."""
    found = {}
    methods = [configuration(f"replay-{num}", f"Replay {num}", replay=num) for num in BATCHES]
    for name in setting.replay:
        task = load(name, setting)
        ran = run(
            task,
            methods,
            setting.replay_seeds,
            folder / "runs" / name,
            setting=setting.name,
            fresh=fresh,
        )
        grid = np.unique(np.geomspace(1, task.budget.evaluations, POINTS).round().astype(int))
        found[name] = {"parameters": size(task), "evaluations": grid.tolist()} | {
            str(num): compare(runs, grid)  # type: ignore[arg-type]
            for num, runs in zip(BATCHES, ran.values(), strict=True)
        }
    return {"starts": setting.replay_seeds, "tasks": found}


def compare(runs: list[Run], grid: np.ndarray) -> dict[str, Any]:
    """Curves, and quartiles over the starts; None where no more than half of them get there."""
    took = [cost_to_level(run["image_error"], run["evaluations"], LEVEL) for run in runs]
    return {
        "took": quartiles(took),
        "final": quartiles([run["image_error"][-1] for run in runs]),
        "curves": band(runs, "image_error", "evaluations", grid).tolist(),
    }


def tables(results: dict[str, Any]) -> Table:
    """The medians."""
    shown = _show.table(
        "Earlier batches seen again: evaluations to 90 %, and what is left at the end, in %",
        f"Medians over {results['starts']} starts; - where not more than half get there.",
        "task",
        "parameters",
        *TITLES.values(),
    )
    for name, task in results["tasks"].items():
        cells = [
            f"{'-' if (took := task[num]['took']['median']) is None else f'{took:.0f}'} "
            f"({_show.short(100 * task[num]['final']['median'])})"
            for num in TITLES
        ]
        shown.add_row(name, str(task["parameters"]), *cells)
    return shown


def draw(results: dict[str, Any], folder: Path) -> None:
    """The curves of each task."""
    tasks = results["tasks"]
    with figure(folder / "replay.png", 1, len(tasks), (3.2 * len(tasks), 3.2)) as (drawn, axes):
        for axis, (name, task) in zip(axes[0], tasks.items(), strict=True):
            for (num, title), colour in zip(TITLES.items(), COLOURS, strict=False):
                low, middle, high = np.maximum(task[num]["curves"], FLOOR)
                axis.plot(task["evaluations"], middle, color=colour, label=title)
                axis.fill_between(task["evaluations"], low, high, color=colour, alpha=0.15, lw=0)
            axis.set(xscale="log", yscale="log", xlabel="Evaluations")
            axis.set_title(f"{name}, {task['parameters']} parameters")
        axes[0, 0].set_ylabel("Image error")
        drawn.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
