"""Descents as pictures: error curves, and what each configuration found beside what is sought."""

from collections.abc import Mapping
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from benchmarks._report import display
from benchmarks._style import COLOURS, figure, legend, looks
from benchmarks.descents._descent import Descent, Pictures
from benchmarks.descents._loop import Run
from benchmarks.descents._runs import Choice

LABELS = {"iterations": "Iterations", "seconds": "Seconds"}
FLOOR = 1e-9  # the smallest error drawn, relative to the largest
BRIGHTEST = 99  # percentile of a grey picture that is shown as white


def write(
    descent: Descent,
    found: dict[str, tuple[Choice, list[Run]]],
    results: dict[str, Any],
    folder: Path,
) -> None:
    """Draws the curves, and the pictures of the first start."""
    curves(results, "iterations", folder / "error-vs-iterations.png")
    curves(results, "seconds", folder / "error-vs-time.png")
    if descent.pictures is None:
        return
    scene = descent.scene(0)
    start = {"Start": descent.pictures(descent.start(0, scene), scene)}
    target = {"Target": descent.target(scene)}
    for mark in descent.pictured or descent.marks[-1:]:
        shown = {
            each.title: descent.pictures(found[each.name][1][0].kept[mark], scene)
            for each in descent.configurations
        }
        panels({**start, **shown, **target}, folder / f"pictures-{mark}.png")


def curves(results: dict[str, Any], cost: str, path: Path) -> None:
    """Median and quartiles over the starts, a panel for each error."""
    configurations = results["configurations"]
    look = looks(configurations)
    errors = list(next(iter(configurations.values()))["errors"])
    with figure(path, 1, len(errors), (4.5 * len(errors), 3.8)) as (drawn, axes):
        for axis, error in zip(axes[0], errors, strict=True):
            for name, found in configurations.items():
                runs = np.array(found["errors"][error], float)  # None, which is infinite, gives NaN
                low, middle, high = np.quantile(
                    np.nan_to_num(runs, nan=np.inf), [0.25, 0.5, 0.75], axis=0, method="higher"
                )
                costs = np.array(found["iterations"], float)
                if cost == "seconds":
                    costs = np.median(found["seconds"], axis=0)
                axis.plot(costs[1:], middle[1:], label=found["title"], **look[name])
                colour = look[name]["color"]
                axis.fill_between(costs[1:], low[1:], high[1:], color=colour, alpha=0.15, lw=0)
            axis.set(xscale="log", xlabel=LABELS[cost], title=error)
            bottom, top = axis.dataLim.intervaly
            if top > 0:
                axis.set(yscale="log", ylim=(max(bottom, FLOOR * top) / 1.3, 1.3 * top))
        legend(drawn, *axes[0, 0].get_legend_handles_labels())
        starts = max(found["runs"] for found in configurations.values())
        drawn.suptitle(
            f"{results['title']} ({results['setting']}): median and quartiles over {starts} starts",
            x=0.01,
            ha="left",
            fontsize=10,
        )


def panels(columns: Mapping[str, Pictures], path: Path) -> None:
    """A grid of pictures: a column for each title, a row for each name of a picture.

    A line is drawn over that of the last column. A row of grey pictures has one scale: that of the
    last column, what is sought, if it has the picture, and else of all. Where there are negative
    values red is negative and blue is positive.
    """
    rows = list(dict.fromkeys(name for pictures in columns.values() for name in pictures))
    *_, sought = columns.values()
    shapes = {name: np.shape(_first(columns, name)) for name in rows}
    width = 2.4 if any(len(shape) == 1 for shape in shapes.values()) else 1.7
    with figure(path, len(rows), len(columns), (width * len(columns), 1.75 * len(rows) + 0.3)) as (
        _,
        axes,
    ):
        for line, name in zip(axes, rows, strict=True):
            scale = _scale(columns, name, sought)
            for axis, pictures in zip(line, columns.values(), strict=True):
                axis.set(xticks=[], yticks=[])
                axis.grid(visible=False)
                axis.spines[:].set_visible(False)
                if name in pictures:
                    _draw(axis, np.asarray(pictures[name]), sought.get(name), scale)
            line[0].set_ylabel(name)
        for axis, title in zip(axes[0], columns, strict=True):
            axis.set_title(fill(title, 20), fontsize=8, loc="center")


def _first(columns: Mapping[str, Pictures], name: str) -> Any:
    return next(pictures[name] for pictures in columns.values() if name in pictures)


def _scale(columns: Mapping[str, Pictures], name: str, sought: Pictures) -> tuple[float, float]:
    if name in sought:
        shown = np.asarray(sought[name])
        low, high = float(shown.min()), float(shown.max())
    else:
        every = np.stack([p[name] for p in columns.values() if name in p])
        low, high = float(every.min()), float(np.percentile(every, BRIGHTEST))
    if low < 0 < high:  # red and blue meet at zero
        low, high = -max(-low, high), max(-low, high)
    return low, high


def _draw(axis, picture: np.ndarray, sought: Any, scale: tuple[float, float]) -> None:
    low, high = scale
    if picture.ndim == 1:
        margin = 0.15 * (high - low)
        axis.plot(np.asarray(sought if sought is not None else picture), color="0.7", lw=2.5)
        axis.plot(picture, color=COLOURS[1], lw=0.8)
        axis.set_ylim(low - margin, high + margin)
    elif picture.ndim == 2:
        colours = "RdBu" if low < 0 < high else "gray"
        axis.imshow(picture, cmap=colours, vmin=low, vmax=high, interpolation="nearest")
    else:
        axis.imshow(display(picture), interpolation="nearest")
