"""How much starts, samples, render noise and compression of the reference matter; Fig. 10.

`python -m benchmarks robustness`: every run is kept on disk as soon as it ends.
"""

import dataclasses
import functools
import itertools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
from rich.console import Console
from tqdm import tqdm

from benchmarks import _harness, methods, tasks
from benchmarks._summary import cost_to_level, machine, quartiles
from benchmarks._task import Budget, Task
from benchmarks.robustness import _pictures, _studies

SCENES = ("shadow", "mug")
BUDGET = Budget(evaluations=240, seconds=60)  # ours are at their end long before
LEVEL = 0.1  # what is left of the parameter error where costs are read


class Setting(NamedTuple):
    """How many starts: of the study of starts, and of each value of the others."""

    name: str
    starts: int
    seeds: int


QUICK, FULL = Setting("quick", starts=12, seeds=5), Setting("full", starts=60, seeds=20)


def main(folder: Path, command: str, *, setting: Setting = QUICK, fresh: bool = False) -> None:
    """Runs what has not been run, prints a table, writes results.json and the picture.

    Args:
        folder: Where the results go.
        command: The command line, for the results.
        setting: How much is run.
        fresh: Run again what has been run.
    """
    scenes = [name for name in SCENES if name in tasks.TASKS]
    results: dict[str, Any] = {
        "command": command,
        "setting": setting.name,
        "machine": machine(),
        "titles": {name: methods.load(name).title for name in _studies.USUAL},
        "scenes": {},
    }
    planned = {name: _planned(name, setting) for name in scenes}
    with tqdm(
        total=sum(_runs(changes, setting) for _, changes in planned.values()), unit="run"
    ) as bar:
        settings = {"setting": setting.name, "fresh": fresh, "progress": bar}
        for name, (task, changes) in planned.items():
            run = functools.partial(_harness.run, **settings)
            studies = _changed(task, changes, folder / "runs" / name, run)
            studies["samples"] = _sampled(task, setting.seeds, folder / "runs" / name, run)
            results["scenes"][name] = studies
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    _pictures.draw(results, folder / "robustness.png")
    console = Console()
    console.print(_pictures.table(results))
    console.print(f"Written to {folder}")


def _planned(name: str, setting: Setting) -> tuple[Task, list[_studies.Change]]:
    """The task of a scene and its changes. It is scored by its parameters only.

    Pictures without noise for a score would take most of a run.
    """
    build = tasks.module(name).build
    usual = build(False)
    away = lambda y: jnp.sum((y - usual.reference) ** 2)
    task = dataclasses.replace(usual, budget=BUDGET, exact_loss=away)
    return task, _studies.changes(build, setting.starts, setting.seeds)


def _runs(changes: Sequence[_studies.Change], setting: Setting) -> int:
    """How many there are of a scene, for the bar."""
    sampled = len(_studies.SAMPLES) * len(_studies.sampling(0)) * setting.seeds
    return len(_studies.USUAL) * sum(len(change.starts) for change in changes) + sampled


def _changed(
    task: Task, changes: Sequence[_studies.Change], folder: Path, run: Callable[..., Any]
) -> dict[str, Any]:
    """What the usual methods take with another start, another render or another reference."""
    usual = [methods.load(name) for name in _studies.USUAL]
    number = sum(len(change.starts) for change in changes)
    found: dict[str, Any] = {}
    for method, runs in run(
        _studies.together(task, changes), usual, number, folder / "all"
    ).items():
        left = iter(runs)
        for change in changes:
            these = list(itertools.islice(left, len(change.starts)))
            line = _line(task, change.value, these, change.starts)
            found.setdefault(change.study, {}).setdefault(method.name, []).append(line)
    return found


def _sampled(task: Task, seeds: int, folder: Path, run: Callable[..., Any]) -> dict[str, Any]:
    """What ours take with other numbers of samples in a step."""
    starts = [task.start(seed) for seed in range(seeds)]
    found: dict[str, Any] = {}
    for num in _studies.SAMPLES:
        for method, runs in run(
            task, _studies.sampling(num), seeds, folder / f"samples-{num}"
        ).items():
            found.setdefault(method.name, []).append(_line(task, num, runs, starts))
    return found


def _line(task: Task, value: int, runs: list[_harness.Run], starts: list[Any]) -> dict[str, Any]:
    """What the runs took, and how far from the reference, in sigmas, they began and ended."""
    took = {
        cost: quartiles([cost_to_level(run["parameter_error"], run[cost], LEVEL) for run in runs])
        for cost in ("evaluations", "seconds")
    }
    begun = [float(jnp.linalg.norm(start - task.reference)) / task.sigma for start in starts]
    ended = [run["distance"] / task.sigma for run in runs]
    return {"value": value, **took, "distance": quartiles(ended), "begun": begun, "ended": ended}
