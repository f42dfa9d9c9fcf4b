"""What the savings of the scenes are worth: a render as it is, and without each of them.

`python -m benchmarks savings`: all renders of a scene are timed in turn, so that what else the
machine does falls on all of them. Times the evaluations that ours takes to 99 %, as results have
them, that is what a saving is worth in seconds; as if the dearer picture took as many evaluations.
"""

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console
from tqdm import tqdm

from benchmarks import tasks
from benchmarks._style import COLOURS, figure
from benchmarks._summary import machine
from benchmarks._task import NotAble, Task
from benchmarks.report._grid import to_rich
from benchmarks.report._savings import table
from benchmarks.report._scene import load
from benchmarks.scenes._dearer import SAVINGS

ROUNDS = 25


def main(folder: Path, scenes: Sequence[str] = tuple(tasks.ALL_SCENES)) -> None:
    """Measures, prints a table, writes results.json and savings.png.

    Args:
        folder: Where the results go; those of the scenes are beside it.
        scenes: The scenes; those without savings that can be undone are left out.
    """
    found = {}
    for name in tqdm(scenes, unit="scene"):
        try:
            task = tasks.module(name).build(False)
        except NotAble:
            continue
        if task.dearer is not None:
            found[name] = {"notes": task.notes, "milliseconds": measure(task)}
    results = {
        "command": "python -m benchmarks savings",
        "machine": machine(),
        "rounds": ROUNDS,
        "scenes": found,
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    _draw(results, folder / "savings.png")
    ran = [scene for name in found if (scene := load(name, folder.parent)) is not None]
    console = Console()
    console.print(to_rich(table(results, ran)))
    console.print(f"Written to {folder}")


def measure(task: Task) -> dict[str, float]:
    """Milliseconds of a render, the fastest of several: what else the machine does only adds."""
    assert task.dearer is not None
    renders, times = task.dearer(), []
    for seed in range(ROUNDS + 1):
        y, took = task.start(seed), {}
        for name, render in renders.items():
            began = time.perf_counter()
            jax.block_until_ready(render(y))
            took[name] = 1e3 * (time.perf_counter() - began)
        times.append(took)
    # the first compiles
    return {name: min(took[name] for took in times[1:]) for name in renders}


def _draw(results: dict[str, Any], path: Path) -> None:
    """A group of bars for each scene."""
    renders = {name: found["milliseconds"] for name, found in results["scenes"].items()}
    places, height = np.arange(len(renders)), 0.8 / len(SAVINGS)
    with figure(path, 1, 1, (7, 1 + 0.6 * len(renders))) as (drawn, axes):
        axis = axes[0, 0]
        for i, (saving, title) in enumerate(SAVINGS.items()):
            times = np.array([took[saving] / took[""] for took in renders.values()])
            middle = places + (i - (len(SAVINGS) - 1) / 2) * height
            axis.barh(middle, times - 1, height, left=1, color=COLOURS[i], label=title)
        axis.axvline(1, color="0.2", lw=1)
        axis.set(xscale="log", xlabel="Times as long as the render as it is")
        axis.set_xticks([1, 2, 5, 10, 20], ["1", "2", "5", "10", "20"])
        axis.xaxis.minorticks_off()
        axis.set_yticks(places, [f"{name}\n{took['']:.1f} ms" for name, took in renders.items()])
        axis.set(ylim=(len(renders) - 0.5, -0.5))
        axis.grid(False, axis="y")
        drawn.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=3)
