"""`python -m benchmarks run`: one task, or all scenes with nothing lost where one fails."""

import json
from argparse import Namespace
from pathlib import Path
from types import ModuleType

import jax
from rich.console import Console
from tqdm import tqdm

from benchmarks import _registry, _study
from benchmarks._task import NotAble

STARTS = {False: 5, True: 20}  # of most scenes, quick and full: a guess, for the bar only


def shown_by(name: str) -> ModuleType:
    """What measures, draws and shows a task, by its kind. Imported when it is asked for."""
    if _registry.task(name).kind == "descent":
        from benchmarks import _descents

        return _descents
    from benchmarks import _black_boxes

    return _black_boxes


def run_one(name: str, options: Namespace, folder: Path, bar: tqdm | None = None) -> None:
    """Measures one task, writes results.json and pictures, and prints tables.

    Args:
        name: The name of the task.
        options: The command line's.
        folder: Where the results go.
        bar: The bar of several scenes, or None.
    """
    study = shown_by(name)
    measured = study.measure(name, options, folder, bar)
    results = _study.write(_study.about(options) | measured, folder)
    study.draw(results, folder)
    if bar is not None:
        bar.clear()
    _study.show(study.tables(results))
    committed = _study.COMMITTED / name / "results.json"
    if options.compare and committed.exists():
        theirs = json.loads(committed.read_text())
        _study.show(study.compare(results, theirs))
    Console().print(f"Written to {folder}")


def run_scenes(options: Namespace, folder: Path) -> None:
    """Runs all scenes, one after the other, with one bar; a scene that fails is named at the end.

    Args:
        options: The command line's.
        folder: Each scene has a folder in it.
    """
    from benchmarks._black_boxes import forgiving, usual

    starts = options.seeds or STARTS[options.full]
    planned = {name: len(usual(name, options)) * starts for name in _registry.scenes()}
    missing = []
    with tqdm(total=sum(planned.values()), unit="run") as bar:
        while planned:
            name = next(iter(planned))
            try:
                with forgiving():
                    run_one(name, options, folder / name, bar)
            except NotAble as reason:
                missing.append(f"{name} is not able here: {reason}.")
            del planned[name]
            bar.total = bar.n + sum(planned.values())
            jax.clear_caches()  # what was compiled for it would stay in memory
    for line in missing:
        Console().print(line, markup=False)
    Console().print("The page of these runs: python -m benchmarks report --runs")
