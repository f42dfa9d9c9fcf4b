"""Runs tasks as the command line asks: one, or all scenes with nothing lost where one fails."""

import json
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import jax
from rich.console import Console
from tqdm import tqdm

from benchmarks import methods, tasks
from benchmarks._task import Method, NotAble, Solve, Task

STARTS = {"quick": 5, "full": 20}  # of most scenes: a guess, for the bar only
LONGEST = 2_000  # parameters; more are in the pictures and in the files of the runs only


def run_one(
    name: str, options: Namespace, folder: Path, command: str, bar: tqdm | None = None
) -> None:
    """Runs methods on one task, writes results.json and pictures, and prints tables.

    Args:
        name: The name of the task.
        options: The command line's: full, seeds, methods and fresh.
        folder: Where the results go.
        command: The command line, for the results.
        bar: The bar of several scenes. With it, a method that fails is named like one that is
            not able, and the others go on.
    """
    from benchmarks import _family, _report, descents

    built = tasks.module(name).build(options.full)
    first = built[0] if isinstance(built, list) else built
    if isinstance(first, descents.Descent):
        descents.run(built, options, folder, command)
        return
    chosen = _methods(name, options)
    if isinstance(built, list):
        members = [
            _run_task(task, chosen, options, folder / task.name, command, bar) for task in built
        ]
        results = _family.summarise(tasks.module(name).TITLE, members)
        _family.draw(results, folder / "evaluations.png")
        shown = _family.tables(results)
    else:
        results = _run_task(built, chosen, options, folder, command, bar)
        shown = _report.tables(results)
    _write(folder, results)
    if bar is not None:
        bar.clear()
    console = Console()
    console.print(shown)
    console.print(f"Written to {folder}")


def run_scenes(options: Namespace, results: Path, command: str) -> None:
    """Runs all scenes, one after the other, with one bar; a scene that fails is named at the end.

    Args:
        options: As for `run_one`.
        results: Each scene has a folder in it.
        command: The command line, for the results.
    """
    starts = options.seeds or STARTS["full" if options.full else "quick"]
    planned = {name: len(_methods(name, options)) * starts for name in tasks.ALL_SCENES}
    missing = []
    with tqdm(total=sum(planned.values()), unit="run") as bar:
        while planned:
            name = next(iter(planned))
            try:
                with _forgiving():
                    run_one(name, options, results / name, command, bar)
            except NotAble as reason:
                missing.append(f"{name} is not able here: {reason}.")
            del planned[name]
            bar.total = bar.n + sum(planned.values())
            jax.clear_caches()  # what was compiled for it would stay in memory
    console = Console()
    for line in missing:
        console.print(line, markup=False)
    console.print("The page of all scenes: python -m benchmarks report")


def _methods(name: str, options: Namespace) -> list[str]:
    """Those that were asked for, or the task's own, or the usual ones."""
    if options.methods:
        return options.methods.split(",")
    usual = methods.SCENES if name in tasks.ALL_SCENES else methods.QUICK
    if options.full:
        usual = methods.METHODS
    return list(getattr(tasks.module(name), "METHODS", usual))


def _run_task(
    task: Task,
    chosen: list[str],
    options: Namespace,
    folder: Path,
    command: str,
    bar: tqdm | None,
) -> dict:
    from benchmarks import _report, _summary
    from benchmarks._harness import run
    from benchmarks.report import _atlas

    setting = "full" if options.full else "quick"
    loaded = [methods.load(method) for method in chosen]
    found = run(
        task,
        loaded if bar is None else [_forgiven(method) for method in loaded],
        options.seeds or task.seeds,
        folder / "runs",
        setting=setting,
        fresh=options.fresh,
        progress=True if bar is None else bar,
    )
    folder.mkdir(parents=True, exist_ok=True)
    results = _summary.summarise(task, found, setting, command)
    _report.write(task, results, folder)
    if task.image is not None:
        _atlas.store(task, results, folder)
    return results


def _write(folder: Path, results: dict) -> None:
    """Writes all or nothing: a report may be made at any time."""
    for found in results.get("methods", {}).values():
        for run in found.get("runs", []):
            if len(run["found"]) > LONGEST:
                del run["found"]
    temporary = folder / "results.tmp"
    temporary.write_text(json.dumps(results, indent=1) + "\n")
    temporary.replace(folder / "results.json")


def _forgiven(method: Method) -> Method:
    """The same method; where it fails it is not able."""

    def prepare(task: Task) -> Solve:
        with _forgiving():
            solve = method.prepare(task)

        def forgiven(y0, key, record):
            with _forgiving():
                solve(y0, key, record)

        return forgiven

    return method._replace(prepare=prepare)


@contextmanager
def _forgiving() -> Iterator[None]:
    """Makes of any failure a NotAble that says that it failed."""
    from benchmarks._harness import Stop

    try:
        yield
    except (NotAble, Stop):
        raise
    except Exception as error:
        if "KeyboardInterrupt" in str(error):  # in a callback it has lost its type
            raise KeyboardInterrupt from error
        lines = str(error).splitlines() or [""]
        raise NotAble(f"failed: {type(error).__name__}: {lines[0][:200].rstrip('.')}") from error
