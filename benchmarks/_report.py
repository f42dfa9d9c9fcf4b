"""Results as pictures and as a table on the terminal."""

import math
from collections.abc import Container
from pathlib import Path
from textwrap import fill
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from rich import box
from rich.console import Group
from rich.table import Table

from benchmarks._style import CROWDED, figure, legend, looks
from benchmarks._summary import COSTS, LEVELS, band
from benchmarks._task import Task

FLOORS = {"image_error": 1e-7, "parameter_error": 1e-7, "gap": 1e-10}  # the smallest error drawn
PICTURED = 3  # starts in images.png, if the pictures of one go in a line
ABREAST = 10  # square pictures in a line of it
SQUARE, TEXT = 1.7, 0.5  # inches: the side of such a picture, and two lines of text
LABELS = {
    "image_error": "Image error (loss), relative to the start",
    "parameter_error": "Parameter error, relative to the start",
    "gap": "Loss above its lowest value",
    "evaluations": "Evaluations",
    "seconds": "Seconds",
}
CAPTIONS = {
    "image_error": "On renders without noise, which are not charged.",
    "parameter_error": "Seconds are without compilation.",
    "gap": "It is absolute.",
}


def write(task: Task, results: dict[str, Any], folder: Path) -> None:
    """Draws what there is to draw."""
    if not able(results):
        return
    _curves(results, "seconds", folder / "error-vs-time.png")
    _curves(results, "evaluations", folder / "error-vs-evaluations.png")
    if task.image is not None:
        _images(task, results, folder / "images.png")


def able(results: dict[str, Any]) -> dict[str, Any]:
    """The methods that ran."""
    return {name: found for name, found in results["methods"].items() if "runs" in found}


def ours_of(methods: dict[str, Any]) -> list[str]:
    """Those that are this library's."""
    return [name for name, found in methods.items() if "(ours)" in found["title"]]


def errors_of(results: dict[str, Any]) -> list[str]:
    """The errors by which the methods were scored."""
    methods = able(results).values()
    return [error for error in LEVELS if any(error in found for found in methods)]


def _curves(results: dict[str, Any], cost: str, path: Path) -> None:
    """Median and quartiles over the starts, a panel for each error."""
    methods, errors = able(results), errors_of(results)
    strong = ours_of(methods) if len(methods) > CROWDED else []
    look = looks(methods, strong)
    with figure(path, 1, len(errors), (4.5 * len(errors), 3.8)) as (drawn, axes):
        for axis, error in zip(axes[0], errors, strict=True):
            panel(axis, methods, look, error, cost, strong or methods)
        count = max(found["starts"] for found in methods.values())
        starts = "1 start" if count == 1 else f"{count} starts"
        what = "medians, quartiles of ours," if strong else "median and quartiles"
        handles, labels = axes[0, 0].get_legend_handles_labels()
        legend(drawn, handles, labels)
        drawn.suptitle(
            f"{results['title']} ({results['setting']}): {what} over {starts}",
            x=0.01,
            ha="left",
            fontsize=10,
        )


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
        runs = found["runs"]
        costs = np.concatenate([run[cost] for run in runs])
        if not costs.any():  # it gave up at once
            continue
        grid = np.geomspace(costs[costs > 0].min(), costs.max(), 200)
        low, middle, high = np.maximum(band(runs, error, cost, grid), FLOORS[error])
        axis.plot(grid, middle, label=found["title"], **look[name])
        if name in banded:
            axis.fill_between(grid, low, high, color=look[name]["color"], alpha=0.15, lw=0)
        lowest, highest = min(lowest, middle.min()), max(highest, middle.max())
    axis.set(ylim=(lowest / 1.3, highest * 1.3))
    axis.set(xscale="log", yscale="log", xlabel=LABELS[cost], title=LABELS[error])
    for level in (level for level in LEVELS[error].values() if level >= lowest):
        axis.axhline(level, color="0.6", lw=0.6, ls=":", zorder=0)


def _images(task: Task, results: dict[str, Any], path: Path) -> None:
    """Start, found by each method, and reference, for the first starts: none is picked by hand."""
    assert task.image is not None
    methods = able(results)
    _, unravel = ravel_pytree(task.reference)
    # each as large as a square one
    high, wide = task.image(task.reference).shape[:2]
    tall = math.sqrt(high / wide)
    # lines of about the same length for a start, as many as it takes
    lines = -(-(len(methods) + 2) // max(1, int(ABREAST * tall)))
    columns = -(-(len(methods) + 2) // lines)
    starts = min(found["starts"] for found in methods.values())
    starts = min(starts, PICTURED) if lines == 1 else 1
    size = SQUARE / tall * columns, (SQUARE * tall + TEXT) * lines * starts + 0.6
    with figure(path, lines * starts, columns, size) as (_, axes):
        for axis in axes.flat:
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_visible(False)
        for seed, places in enumerate(axes.reshape(starts, -1)):
            runs = [found["runs"][seed] for found in methods.values()]
            found = [unravel(jnp.asarray(run["found"])) for run in runs]
            shown = [task.start(seed), *found, task.reference]
            errors = ["1", *(f"{run['image_error'][-1]:.2g}" for run in runs), "0"]
            names = ["Start", *(found["title"] for found in methods.values()), "Reference"]
            for axis, y, name, error in zip(places, shown, names, errors, strict=False):
                axis.imshow(display(task.image(y)), interpolation="nearest")
                axis.set_xlabel(f"error {error}")
                axis.set_title(fill(name, 20), fontsize=8, loc="center")
            places[0].set_ylabel(f"start {seed}")


def display(image) -> np.ndarray:
    """Linear RGB as a screen shows it."""
    linear = np.clip(np.asarray(image), 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def tables(results: dict[str, Any]) -> Group:
    """What each level took and what was left at the end, for the terminal."""
    methods = results["methods"]
    not_able = [
        f"{found['title']} is not able here: {found['not_able']}."
        for name, found in methods.items()
        if name not in able(results)
    ]
    took = [_took(results, error) for error in errors_of(results)]
    return Group(*took, _left(results), *not_able)


def _took(results: dict[str, Any], error: str) -> Table:
    kind, unit = error.replace("_", " "), "" if error == "gap" else " %"
    shown = Table(
        title=f"{results['title']} ({results['setting']}): reducing the {kind}",
        caption=f"Median \\[quartiles] over the starts; - is not reached. {CAPTIONS[error]}",
        box=box.SIMPLE_HEAD,
    )
    shown.add_column("method")
    for column in ("to" if error == "gap" else "reduction", "solved", *COSTS):
        shown.add_column(column, justify="right", no_wrap=True)
    for found in able(results).values():
        for i, (level, reached) in enumerate(found[error]["levels"].items()):
            shown.add_row(
                "" if i else found["title"],
                level + unit,
                f"{reached['solved']}/{found['starts']}",
                *(show(reached[cost]) for cost in COSTS),
            )
        shown.add_section()
    return shown


def _left(results: dict[str, Any]) -> Table:
    budget = results["budget"]
    shown = Table(
        title=f"At the end, after {budget['evaluations']} evaluations or {budget['seconds']} s",
        caption="Distance in units of the parameters. Compilation is not charged.",
        box=box.SIMPLE_HEAD,
    )
    shown.add_column("method")
    for column in ("image error", "parameter error", "distance", "compile"):
        shown.add_column(column, justify="right")
    for found in able(results).values():
        errors = [show(found[error]["final"]) for error in ("image_error", "parameter_error")]
        compiling = f"{found['warm_up_seconds']:.1f} s"
        shown.add_row(found["title"], *errors, show(found["distance"]), compiling)
    return shown


def show(quartiles: dict[str, float | None]) -> str:
    low, middle, high = (
        "-" if q is None else f"{q:.2g}" if q < 10 else f"{q:.0f}"
        for q in (quartiles[name] for name in ("lower", "median", "upper"))
    )
    return middle if middle == low == high else f"{middle} \\[{low}, {high}]"
