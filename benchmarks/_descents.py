"""Descents as a study: configurations are tuned and run, and what they reached is drawn and shown.

Each is tuned by a walk on the same grid, on seeds that are not scored, once for every mark that is
shown, and is then run from the scored ones.
"""

from argparse import Namespace
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from textwrap import fill
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from tqdm import tqdm

from benchmarks import _loop, _registry
from benchmarks._atlas import display
from benchmarks._descent import Configuration, Descent, axes, method, observed
from benchmarks._grid import Grid, Row, spread
from benchmarks._study import setting
from benchmarks._style import COLOURS, band, figure, headed, legend, looks, panels
from benchmarks._summary import cost_to_level, quartiles
from benchmarks._task import precision_of
from benchmarks._tuning import Best, Settings, geometric_mean, seeds, walk

FILES = {"iterations": "error-vs-iterations.png", "seconds": "error-vs-time.png"}
EARLY = (1, 2, 3)  # iterations at which every run is looked at, so that warming up is short
FLOOR = 1e-9  # the smallest error drawn, relative to the largest
BRIGHTEST = 99  # percentile of a grey picture that is shown as white


def measure(name: str, options: Namespace, folder: Path, bar: tqdm | None = None) -> dict[str, Any]:
    """Compares the configurations of a task, or of each task of a family.

    The folder keeps the runs, and has pictures of what the first start found.
    """
    family = {task.name: task for task in _registry.family(name, options.full)}
    bar = bar or tqdm(unit="run")  # how many a walk takes is not known
    how: dict[str, Any] = {"setting": setting(options), "fresh": options.fresh, "progress": bar}
    run = partial(_loop.run, folder=folder / "raw", **how)
    tasks = {}
    for member, task in family.items():
        assert isinstance(task, Descent)
        shared = replace(task, name=name)  # a family has runs in common
        with precision_of(task):
            into = _folder(folder, member, family)
            tasks[member] = compared(shared, options.seeds or task.seeds, run, into)
    return {"title": _registry.task(name).title, "tasks": tasks}


def compared(
    task: Descent, starts: int, run: Callable[..., _loop.Runs], folder: Path
) -> dict[str, Any]:
    """What the results say of a task. What the first start found is drawn into a folder."""
    found, pictured = {}, task.pictured or task.marks[-1:]
    firsts: dict[int, dict[str, Any]] = {mark: {} for mark in pictured}
    for each in task.configurations:
        choices = tune(task, each, run)
        looked_at = observed(task.marks[-1], task.marks)
        chosen = {m: method(task, each, of.settings, looked_at) for m, of in choices.items()}
        runs = _loop.able(run(task, list(set(chosen.values())), range(starts), keep=pictured))
        of_marks = {mark: runs[how] for mark, how in chosen.items()}
        tuned = {mark: of._asdict() for mark, of in choices.items()}
        found[each.name] = {"title": each.title, "tuned": tuned, **_of_runs(task, of_marks)}
        for mark in pictured:
            firsts[mark][each.title] = of_marks[mark][0][f"found {mark}"]
    for mark in pictured if task.pictures else ():
        _draw_found(task, firsts[mark], folder / f"pictures-{mark}.png")
    return {
        "title": task.title,
        "notes": task.notes,
        "score": task.scored,
        "starts": starts,
        "tuning_seeds": task.tuning_seeds,
        "configurations": found,
    }


def tune(
    task: Descent, configuration: Configuration, run: Callable[..., _loop.Runs]
) -> dict[int, Best]:
    """By mark, the settings with the lowest error there, a geometric mean over the tuning seeds."""
    on, known = seeds(task.tuning_seeds), dict[str, dict[int, float]]()

    def errors(settings: Settings) -> dict[int, float]:
        if repr(settings) not in known:
            how = method(task, configuration, settings, (*EARLY, *task.marks))
            runs = _loop.able(run(task, [how], on))[how]
            at = {mark: list(runs[0]["evaluations"]).index(mark) for mark in task.marks}
            left = {mark: [one[task.scored][i] for one in runs] for mark, i in at.items()}
            known[repr(settings)] = {mark: geometric_mean(each) for mark, each in left.items()}
        return known[repr(settings)]

    grid, start = axes(task, configuration)
    found: dict[int, Best] = {}
    for mark in task.marks:
        found[mark] = walk(lambda settings: errors(settings)[mark], grid, start)  # noqa: B023
        start = found[mark].settings
    return found


def _of_runs(task: Descent, of_marks: dict[int, list[_loop.Run]]) -> dict[str, Any]:
    """Errors at the marks, each by the runs that were tuned for it; the rest is of the last."""
    last = of_marks[task.marks[-1]]
    iterations = last[0]["evaluations"].tolist()
    stacked = lambda runs, name: np.stack([run[name] for run in runs])
    errors = {name: stacked(last, name) for name in task.score.levels}
    at = lambda mark, name: list(stacked(of_marks[mark], name)[:, iterations.index(mark)])
    took = lambda level: [cost_to_level(e, iterations, level) for e in errors[task.scored]]
    return {
        "iterations": iterations,
        "seconds": np.median([run["seconds"] for run in last], axis=0).tolist(),
        "curves": {
            name: np.quantile(each, [0.25, 0.5, 0.75], axis=0, method="higher").tolist()
            for name, each in errors.items()
        },
        "at_marks": {
            name: {mark: quartiles(at(mark, name)) for mark in task.marks} for name in errors
        },
        "to_levels": {level: quartiles(took(level)) for level in task.score.levels[task.scored]},
        "ms_an_iteration": quartiles([1e3 * run["seconds"][-1] / iterations[-1] for run in last]),
    }


def tables(results: dict[str, Any]) -> Iterator[Grid]:
    """Of each task: errors at the marks, a table for each error, what was tuned, and levels."""
    for task in results["tasks"].values():
        configurations = list(task["configurations"].values())
        for error, marks in configurations[0]["at_marks"].items():
            shown = ((of["title"], of["at_marks"][error].values()) for of in configurations)
            yield Grid(
                title=f"{task['title']}: {error}",
                caption="Median [quartiles] over the starts, after so many iterations; tuned for "
                "each of them.",
                columns=("configuration", *marks),
                rows=tuple(Row(name, tuple(map(spread, found))) for name, found in shown),
            )
        yield _of_tuning(task, configurations)
        yield _to_levels(task, configurations)


def _of_tuning(task: dict[str, Any], configurations: list[dict[str, Any]]) -> Grid:
    def said(choice: dict[str, Any]) -> str:
        each = choice["settings"].items()
        values = (f"{name} {value:g}{'*' * (name in choice['ends'])}" for name, value in each)
        return ", ".join(values)

    rows = (Row(of["title"], tuple(map(said, of["tuned"].values()))) for of in configurations)
    return Grid(
        title=f"{task['title']}: settings",
        caption="By a walk on one grid, on other starts, for the error after so many iterations. "
        "1 - b2 = (1 - b1)^tie; * is an end of its axis, natural for b1 0, tie 1 and levels 1.",
        columns=("configuration", *configurations[0]["tuned"]),
        rows=tuple(rows),
        numbers=False,
    )


def _to_levels(task: dict[str, Any], configurations: list[dict[str, Any]]) -> Grid:
    usual = configurations[0]["ms_an_iteration"]["median"]
    rows = []
    for found in configurations:
        extra = found["ms_an_iteration"]["median"] / usual - 1
        time = spread(found["ms_an_iteration"]), f"{100 * extra:.0f} %"
        rows.append(Row(found["title"], (*map(spread, found["to_levels"].values()), *time)))
    return Grid(
        title=f"Iterations until the {task['score']} is at most",
        caption="Tuned for the last mark. - is not reached. Extra time is that of an iteration "
        "over the first line's.",
        columns=("configuration", *configurations[0]["to_levels"], "ms/iteration", "extra time"),
        rows=tuple(rows),
    )


def compare(results: dict[str, Any], committed: dict[str, Any]) -> Iterator[Grid]:
    """The tables of the committed results: they are of the same form, to be read beside these."""
    for grid in tables(committed):
        yield grid._replace(title=f"Committed: {grid.title}", caption=committed["machine"]["cpu"])


def draw(results: dict[str, Any], folder: Path) -> None:
    """Draws the errors against iterations and seconds."""
    for name, task in results["tasks"].items():
        for cost, file in FILES.items():
            _curves(task, cost, _folder(folder, name, results["tasks"]) / file)


def _folder(folder: Path, name: str, family: Collection[str]) -> Path:
    """Each task of a family has its own."""
    return folder / name if len(family) > 1 else folder


def _curves(task: dict[str, Any], cost: str, path: Path) -> None:
    """Median and quartiles over the starts, a panel for each error.

    The line is of what was tuned for the last mark, the points are of what was tuned for theirs.
    """
    configurations = task["configurations"]
    look = looks(configurations)
    names = list(next(iter(configurations.values()))["curves"])
    with panels(path, names, len(names), (4.5, 3.2)) as (drawn, axes):
        for axis, error in zip(axes[0], names, strict=True):
            for name, found in configurations.items():
                costs = found[cost][1:]
                errors = np.array(found["curves"][error], float)[:, 1:]
                band(axis, costs, errors, look[name], found["title"])
                if cost == "iterations":
                    _mark(axis, found["at_marks"][error], look[name])
            bottom, top = axis.dataLim.intervaly
            axis.set(xscale="log", xlabel=cost.capitalize())
            axis.set(yscale="log", ylim=(max(bottom, FLOOR * top) / 1.3, 1.3 * top))
        legend(drawn, *axes[0, 0].get_legend_handles_labels())
        headed(drawn, f"{task['title']}\nMedian and quartiles over {task['starts']} starts")


def _mark(axis: Any, marks: dict[str, Any], look: dict[str, Any]) -> None:
    """The medians at the marks; what is not there has no point."""
    medians = [(float(mark), found["median"]) for mark, found in marks.items()]
    shown = [(mark, median) for mark, median in medians if median is not None]
    axis.plot(*zip(*shown, strict=True), "o", ms=4, color=look["color"]) if shown else None


def _draw_found(task: Descent, found: dict[str, np.ndarray], path: Path) -> None:
    """A column of pictures for each y found, by title, between the start's and the target's.

    A line is drawn over the target's. A row of grey pictures has one scale: that of the target if
    it has the picture, and else of all.
    """
    assert task.pictures is not None
    scene, unravel = task.scene(0), ravel_pytree(task.problem.like)[1]
    ys = {"Start": task.start(0)} | {title: unravel(jnp.asarray(y)) for title, y in found.items()}
    columns = {title: task.pictures(y, scene) for title, y in ys.items()}
    names, sought = list(columns["Start"]), task.target(scene)
    columns["Target"] = sought
    width = 2.4 if any(np.ndim(picture) == 1 for picture in sought.values()) else 1.7
    size = width * len(columns), 1.75 * len(names) + 0.3
    with figure(path, len(names), len(columns), size) as (_, axes):
        for line, name in zip(axes, names, strict=True):
            shown = [np.asarray(of[name]) for of in columns.values() if name in of]
            low, high = np.min(shown), np.percentile(shown, BRIGHTEST)
            if name in sought:
                low, high = np.min(shown[-1]), np.max(shown[-1])
            for axis in line:
                axis.set(xticks=[], yticks=[])
                axis.grid(visible=False)
                axis.spines[:].set_visible(False)
            for axis, picture in zip(line, shown, strict=False):
                _show(axis, picture, shown[-1], low, high)
            line[0].set_ylabel(name)
        for axis, title in zip(axes[0], columns, strict=True):
            axis.set_title(fill(title, 20), fontsize=8, loc="center")


def _show(axis, picture: np.ndarray, sought: np.ndarray, low: float, high: float) -> None:
    if picture.ndim == 1:
        margin = 0.15 * (high - low)
        axis.plot(sought, color="0.7", lw=2.5)
        axis.plot(picture, color=COLOURS[1], lw=0.8)
        axis.set_ylim(low - margin, high + margin)
    elif picture.ndim == 2:
        axis.imshow(picture, cmap="gray", vmin=low, vmax=high, interpolation="nearest")
    else:
        axis.imshow(display(picture), interpolation="nearest")
