"""What it is worth that earlier batches are seen again, which the paper does not do.

Ours with 100 batches and with none, all else as it is for a task of its size: with up to 50
parameters the former is the default, beyond it the latter.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks._grid import Grid, Row, short
from benchmarks._loop import Run
from benchmarks._summary import cost_to_level, quartiles
from benchmarks.studies.zerograds._runs import (
    about,
    configuration,
    curves,
    errors,
    load,
    panels,
    ran,
    sized,
)

TASKS = ("rocket10", "wicker", "node-graph", "led")
TITLES = {"100": "100 batches seen again", "0": "none"}
LEVEL = 0.1  # of the error of the start, where evaluations are read
FLOOR = 1e-3  # the smallest error that is drawn


def measure(starts: int, folder: Path, fresh: bool) -> dict[str, Any]:
    """Curves, evaluations to the level and errors at the end, by task and number of batches."""
    tasks = {}
    for name in TASKS:
        task = load(name)
        methods = [configuration(number, replay=int(number)) for number in TITLES]
        runs = ran(task, methods, starts, folder / "replay", fresh)
        tasks[name] = known = about(task)
        known |= {number: compare(each, known["evaluations"]) for number, each in runs.items()}
    return {"tasks": tasks}


def compare(runs: list[Run], evaluations: Sequence[int]) -> dict[str, Any]:
    """Curves, and quartiles over the starts; None where no more than half of them get there."""
    took = [cost_to_level(run["image_error"], run["evaluations"], LEVEL) for run in runs]
    return {
        "took": quartiles(took),
        "final": quartiles([float(run["image_error"][-1]) for run in runs]),
        "curves": errors(runs, evaluations),
    }


def tables(results: dict[str, Any]) -> Iterator[Grid]:
    """The medians."""
    rows = []
    for name, task in results["tasks"].items():
        medians = ((task[n]["took"]["median"], task[n]["final"]["median"]) for n in TITLES)
        cells = (f"{short(took)} ({short(100 * left)})" for took, left in medians)
        rows.append(Row(name, (str(task["parameters"]), *cells)))
    yield Grid(
        "Earlier batches seen again: evaluations to 90 % (and what is left at the end, in %)",
        f"Medians over {results['starts']} starts; - where not more than half get there.",
        ("task", "parameters", *TITLES.values()),
        tuple(rows),
    )


def draw(results: dict[str, Any], path: Path) -> None:
    """The curves of each task."""
    with panels(path, sized(results["tasks"]), "Evaluations", "Image error") as axes:
        for axis, task in axes:
            found = {title: task[number]["curves"] for number, title in TITLES.items()}
            curves(axis, task["evaluations"], found, FLOOR)
            axis.set(xscale="log", yscale="log")
