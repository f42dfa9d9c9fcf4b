"""The results of a task as pictures: errors against costs, and what each method found."""

import math
from collections.abc import Container
from itertools import groupby
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from benchmarks._atlas import frames, stored
from benchmarks._grid import short
from benchmarks._names import NAMES, is_ours, name_of
from benchmarks._reached import alike
from benchmarks._style import CROWDED, band, figure, headed, legend, looks, panels
from benchmarks._summary import COSTS, GAPS, LEVELS, able, grid

FLOORS = {"image_error": 1e-7, "parameter_error": 1e-7, "gap": 1e-10}  # the smallest error drawn
ABREAST = 10  # square pictures in a line
SQUARE, TEXT = 1.7, 0.5  # inches: the side of such a picture, and two lines of text
GAP = min(GAPS, key=lambda name: GAPS[name])  # that families are compared at
COLUMNS = 4  # of a family's panels
FEWEST = 5  # evaluations that are drawn
LABELS = {
    "image_error": "Image error (loss), relative to the start",
    "parameter_error": "Parameter error, relative to the start",
    "gap": "Loss above its lowest value",
    "evaluations": "Evaluations",
    "seconds": "Seconds",
}
FILES = {"evaluations": "error-vs-evaluations.png", "seconds": "error-vs-time.png"}


def draw(results: dict[str, Any], folder: Path) -> None:
    """Draws what there is to draw; each task of a family into a folder of its own."""
    tasks = {name: task for name, task in results["tasks"].items() if able(task)}
    for name, task in tasks.items():
        into = folder / name if len(results["tasks"]) > 1 else folder
        for cost in COSTS if _has_curves(task) else ():
            _curves(task, cost, into / FILES[cost])
        _images(task, into / "images.png")
        if task.get("film"):
            _film(task, into / "film.png")
    if len(tasks) > 1 and all("gap" in errors_of(task) for task in tasks.values()):
        _family(results, folder / "evaluations.png")


def errors_of(task: dict[str, Any]) -> list[str]:
    """The errors by which the methods were scored."""
    return [error for error in LEVELS if any(error in f["final"] for f in able(task).values())]


def names_of(tasks: dict[str, Any]) -> dict[str, str]:
    """Of all methods that ran on any of the tasks."""
    ran = (each for task in tasks.values() for each in able(task).items())
    return {method: name_of(method, found["title"]) for method, found in ran}


def _has_curves(task: dict[str, Any]) -> bool:
    curves = [found["curves"] for found in able(task).values()]
    return any(curve["ends"] for each in curves for of in each.values() for curve in of.values())


def _curves(task: dict[str, Any], cost: str, path: Path) -> None:
    """Median and quartiles over the starts, a panel for each error.

    Seconds are drawn of those methods that ran where the last one did, which is ours.
    """
    methods, errors = able(task), errors_of(task)
    if cost == "seconds":
        methods = {name: methods[name] for name in alike(task, [*methods][-1])}
    strong = list(filter(is_ours, methods)) if len(methods) > CROWDED else []
    look = looks(methods)
    with figure(path, 1, len(errors), (4.5 * len(errors), 3.8)) as (drawn, axes):
        for axis, error in zip(axes[0], errors, strict=True):
            panel(axis, methods, look, error, cost, strong or methods)
        count = max(found["starts"] for found in methods.values())
        starts = "1 start" if count == 1 else f"{count} starts"
        what = "medians, quartiles of ours," if strong else "median and quartiles"
        legend(drawn, *axes[0, 0].get_legend_handles_labels())
        title = f"{task['title']}: {what} over {starts}"
        headed(drawn, title)


def panel(
    axis,
    methods: dict[str, Any],
    look: dict[str, dict],
    error: str,
    cost: str,
    banded: Container[str],
) -> None:
    """Median of one error over the starts, against what they cost; quartiles for those `banded`."""
    lowest, highest = 0.1, 1.0
    for name, found in methods.items():
        curve = found["curves"][error][cost]
        if curve["ends"] is None:
            continue
        costs = grid(curve["ends"])
        quartiles = np.nan_to_num(np.array(curve["quartiles"], float), nan=np.inf)
        three = np.maximum(quartiles, FLOORS[error])
        label = name_of(name, found["title"])
        band(axis, costs, three, look[name], label, 0.15 if name in banded else 0)
        axis.update_datalim([(end, 1) for end in curve["ends"]])  # of one that diverged too
        shown = three[1][np.isfinite(three[1])]
        lowest, highest = min([lowest, *shown]), max([highest, *shown])  # there may be none
    axis.set(ylim=(lowest / 1.3, highest * 1.3))
    axis.set(xscale="log", yscale="log", xlabel=LABELS[cost], title=LABELS[error])
    for level in (level for level in LEVELS[error].values() if level >= lowest):
        axis.axhline(level, color="0.6", lw=0.6, ls=":", zorder=0)


def _images(task: dict[str, Any], path: Path) -> None:
    """Start, found by each method, and reference, from the first start: none is picked by hand."""
    methods = able(task)
    pictures = stored(task, list(methods))
    if pictures is None:
        return
    shown = [pictures.start, *pictures.found.values(), pictures.reference]
    errors = ["1", *(short(found["first"]) for found in methods.values()), "0"]
    names = ["Start", *names_of({"": task}).values(), "Reference"]
    # each as large as a square one, in lines of about the same length
    tall = math.sqrt(shown[0].shape[0] / shown[0].shape[1])
    lines = -(-len(shown) // max(1, int(ABREAST * tall)))
    columns = -(-len(shown) // lines)
    size = SQUARE / tall * columns, (SQUARE * tall + TEXT) * lines + 0.6
    with figure(path, lines, columns, size) as (_, axes):
        for axis in axes.flat:
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_visible(False)
        for axis, picture, name, error in zip(axes.flat, shown, names, errors, strict=False):
            axis.imshow(picture, interpolation="nearest")
            axis.set_xlabel(f"error {error}")
            axis.set_title(fill(name, 20), fontsize=8, loc="center")


def _film(task: dict[str, Any], path: Path) -> None:
    """A line for each method, what it had found after some evaluations, beside start and goal."""
    film, methods = task["film"], able(task)
    pictures = stored(task, list(methods))
    assert pictures is not None
    lines = {name: each for name, each in frames(film).items() if name in methods}
    heads = ["Start", *(f"{mark} renders" for mark in film["marks"]), "Reference"]
    wide = SQUARE * pictures.start.shape[1] / pictures.start.shape[0]
    size = wide * len(heads) + 1.2, (SQUARE + 0.25) * len(lines) + 0.4
    with figure(path, len(lines), len(heads), size) as (_, axes):
        for line, (name, found) in zip(axes, lines.items(), strict=True):
            shown = [pictures.start, *found, pictures.reference]
            errors = [1.0, *film["errors"][name], 0.0]
            for axis, picture, error in zip(line, shown, errors, strict=True):
                axis.imshow(picture, interpolation="nearest")
                axis.set(xticks=[], yticks=[])
                axis.spines[:].set_visible(False)
                left = None if error is None else 100 * error
                axis.set_xlabel(f"{short(left)} % left", fontsize=8)
            line[0].set_xlabel("")
            line[-1].set_xlabel("")
            weight = "bold" if is_ours(name) else "normal"
            line[0].set_ylabel(name_of(name), weight=weight, color=NAMES[name].colour)
        for axis, head in zip(axes[0], heads, strict=True):
            axis.set_title(head, loc="center")


def _family(results: dict[str, Any], path: Path) -> None:
    """Evaluations to the smallest gap against dimensions, a panel for each function."""
    tasks = results["tasks"]
    names = names_of(tasks)
    look = looks(names)
    named = groupby(tasks.items(), key=lambda item: item[0].rpartition("-")[0])
    functions = {name: [task for _, task in members] for name, members in named}
    most = max(task["budget"]["evaluations"] for task in tasks.values())
    with panels(path, functions, COLUMNS, (3, 2.8)) as (drawn, axes):
        for axis, members in zip(axes.flat, functions.values(), strict=False):
            for method in names:
                _medians(axis, [task for task in members if method in able(task)], method, look)
            dimensions = [task["dimensions"] for task in members]
            axis.set(xscale="log", yscale="log", ylim=(FEWEST, 1.5 * most))
            axis.set_xticks(dimensions, [f"{n}-D" for n in dimensions])
            axis.xaxis.minorticks_off()
        for axis in axes[:, 0]:
            axis.set_ylabel("Evaluations")
        handles = [axes[0, 0].plot([], [], marker="o", **look[name])[0] for name in names]
        legend(drawn, handles, list(names.values()))
        headed(
            drawn,
            f"{results['title']}: median evaluations to a gap of {GAP}\n"
            "Open: the budget, where no more than half of the starts got there",
        )


def _medians(axis, tasks: list[dict[str, Any]], method: str, look: dict[str, dict]) -> None:
    """Those of a method over the dimensions; open at the budget where there is none."""
    medians = [able(task)[method]["took"]["gap"][GAP]["evaluations"]["median"] for task in tasks]
    x = np.array([task["dimensions"] for task in tasks])
    y = np.array([np.nan if median is None else median for median in medians], float)
    budgets = np.array([task["budget"]["evaluations"] for task in tasks], float)
    axis.plot(x, y, marker="o", **look[method])
    missed = np.where(np.isnan(y), budgets, np.nan)
    axis.plot(x, missed, marker="o", ls="none", mfc="none", color=look[method]["color"])
