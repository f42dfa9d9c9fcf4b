"""Tasks that are black boxes, as a study: what is measured on them, drawn and shown."""

from argparse import Namespace
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from benchmarks import _atlas, _loop, _registry
from benchmarks._grid import short
from benchmarks._levels import Race
from benchmarks._pictures import draw
from benchmarks._study import setting
from benchmarks._summary import summarise
from benchmarks._tables import compare, ending, tables
from benchmarks._task import Method, NotAble, Problem, Solve, Task, precision_of
from benchmarks._tune import tune

__all__ = ["compare", "draw", "ending", "forgiving", "measure", "tables", "usual"]


def usual(name: str, options: Namespace) -> list[str]:
    """The methods that were asked for, or those that run on such a task unasked."""
    if options.methods:
        return options.methods.split(",")
    return _registry.methods(None if options.full else _registry.task(name).kind)


def measure(name: str, options: Namespace, folder: Path, bar: tqdm | None = None) -> dict[str, Any]:
    """Runs methods on a task, or on each task of a family; the folder keeps the runs.

    With the bar of several scenes, a method that fails is named like one that is not able, and the
    others go on.
    """
    methods = [_registry.method(method) for method in usual(name, options)]
    if bar is not None:
        methods = [_forgiven(method) for method in methods]
    tasks = {}
    keep = _atlas.MARKS if _registry.task(name).kind == "scene" else ()
    how = {"setting": setting(options), "fresh": options.fresh, "progress": bar}
    for task in _registry.family(name, options.full):
        _check(task)
        seeds = range(options.seeds or task.seeds)
        best = _best(task, methods, folder / "tuned" / task.name) if options.tuned else []
        raw = folder / "raw" / task.name
        runs = _loop.run(task, [*methods, *best], seeds, raw, keep=keep, **how)
        with precision_of(task):
            ran = _loop.able(runs)
            shown = {"pictures": _atlas.rendered(task, ran)}
            shown |= {"film": _atlas.film(task, ran)} if keep else {}
            tasks[task.name] = summarise(task, runs) | shown
    if bar is not None:
        bar.clear()  # what is printed next would be on its line
    return {"title": _registry.task(name).title, "tasks": tasks}


def _check(task: Task) -> None:
    """Black boxes are compared by the same errors, so each says what is sought."""
    if task.score.errors is not None:
        raise ValueError(f"{task.name!r} has errors of its own, which only a Descent may have.")
    if task.score.reference is None and task.choose is None:
        raise ValueError(f"{task.name!r} does not say what is sought: Score(reference=...).")


def _best(task: Task, methods: Sequence[Method], folder: Path) -> list[Method]:
    """Those that have a grid again, each at the best of it, whatever else it is called."""
    race, found = Race(task, folder), []
    for method in methods:
        if not (grid := _registry.grid(method.name)):
            continue
        try:
            best = tune(race, method, grid).settings
        except NotAble:
            continue  # as it is without settings, which is said there
        said = ", ".join(f"{setting} {short(value)}" for setting, value in best.items())
        found.append(
            Method(
                f"{method.name}-best",
                f"{method.title}, best of a grid: {said}",
                partial(method.prepare, **best),
                method.source + said,
            )
        )
    return found


def _forgiven(method: Method) -> Method:
    """The same method; where it fails it is not able."""

    def prepare(problem: Problem) -> Solve:
        with forgiving():
            solve = method.prepare(problem)

        def forgiven(y0, key, record):
            with forgiving():
                solve(y0, key, record)

        return forgiven

    return method._replace(prepare=prepare)


@contextmanager
def forgiving() -> Iterator[None]:
    """Makes of any failure a NotAble that says that it failed."""
    try:
        yield
    except (NotAble, _loop.Stop):
        raise
    except Exception as error:
        if "KeyboardInterrupt" in str(error):  # in a callback it has lost its type
            raise KeyboardInterrupt from error
        lines = str(error).splitlines() or [""]
        raise NotAble(f"failed: {type(error).__name__}: {lines[0][:200].rstrip('.')}") from error
