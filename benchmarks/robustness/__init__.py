"""How much starts, samples, render noise and compression of the reference matter; Fig. 10.

`python -m benchmarks robustness`: every run is kept on disk as soon as it ends.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from rich.console import Console
from tqdm import tqdm

from benchmarks import _harness, tasks
from benchmarks._summary import cost_to_level, machine, quartiles
from benchmarks._task import Budget, Method, NotAble, Task
from benchmarks.robustness import _pictures, _studies

SCENES = ("shadow", "mug")
BUDGET = Budget(evaluations=240, seconds=60)  # ours are at their end long before
LEVEL = 0.1  # what is left of the parameter error where costs are read


class Setting(NamedTuple):
    """How many starts: of the study of starts, and of each value of the others."""

    name: str
    starts: int
    seeds: int


QUICK, FULL = Setting("quick", starts=12, seeds=3), Setting("full", starts=60, seeds=20)


def main(folder: Path, command: str, *, setting: Setting = QUICK) -> None:
    """Runs what has not been run, prints a table, writes results.json and the picture.

    Args:
        folder: Where the results go.
        command: The command line, for the results.
        setting: How much is run.
    """
    scenes = [name for name in SCENES if name in tasks.TASKS]
    results: dict[str, Any] = {
        "command": command,
        "setting": setting.name,
        "machine": machine(),
        "titles": {},
        "scenes": {name: {} for name in scenes},
    }
    cases = {name: _cases(name) for name in scenes}
    runs = sum(_starts(case, setting) * len(case.methods) for c in cases.values() for case in c)
    with tqdm(total=runs, unit="run") as bar:
        for name in scenes:
            for case in cases[name]:
                for method, line in _run(case, setting, folder / "runs" / name, bar).items():
                    results["titles"].setdefault(method.name, method.title)
                    study = results["scenes"][name].setdefault(case.study, {})
                    study.setdefault(method.name, []).append(line)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    _pictures.draw(results, folder / "robustness.png")
    console = Console()
    console.print(_pictures.table(results))
    console.print(f"Written to {folder}")


def _cases(name: str) -> list[_studies.Case]:
    task = tasks.module(name).build(False)
    return _studies.cases(task, _shadow_at if name == "shadow" else None)


def _shadow_at(spp: int) -> Task:
    """Shadow with so many samples of a pixel; the photograph stays."""
    from benchmarks.scenes import shadow

    task = tasks.module("shadow").build(False)
    assert task.image is not None
    render, photo = shadow.make(task.image(task.reference).shape[0], spp)
    return dataclasses.replace(
        task,
        loss=lambda y: jnp.mean((render(y) - photo) ** 2),
        residuals=lambda y: render(y) - photo,
        notes=f"{spp} samples per pixel",
    )


def _starts(case: _studies.Case, setting: Setting) -> int:
    return setting.starts if case.study == "starts" else setting.seeds


def _run(
    case: _studies.Case, setting: Setting, folder: Path, bar: tqdm
) -> dict[Method, dict[str, Any]]:
    """What each method took from the starts, and how far from the reference it ended."""
    starts, task = _starts(case, setting), dataclasses.replace(case.task, budget=BUDGET)
    found = _harness.run(
        task,
        case.methods,
        starts,
        folder / f"{case.study}-{case.value}",
        setting="quick",  # of the task: what is more in full is starts
        progress=bar,
    )
    sought = np.asarray(task.reference)
    begun = [float(np.linalg.norm(task.start(seed) - sought)) for seed in range(starts)]
    return {
        method: _line(case.value, runs, begun, task.sigma)
        for method, runs in found.items()
        if not isinstance(runs, NotAble)
    }


def _line(value: int, runs: list[_harness.Run], begun: list[float], sigma: float) -> dict[str, Any]:
    took = {
        cost: quartiles([cost_to_level(run["parameter_error"], run[cost], LEVEL) for run in runs])
        for cost in ("evaluations", "seconds")
    }
    ended = [run["distance"] / sigma for run in runs]
    return {
        "value": value,
        **took,
        "distance": quartiles(ended),
        "begun": [distance / sigma for distance in begun],
        "ended": ended,
    }
