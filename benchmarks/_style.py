"""One look for all figures: each method its own line, thin grids, no frames."""

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from itertools import product, zip_longest
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.figure import Figure
from PIL import Image

from benchmarks._names import DASHED, DOTTED, MIXED, NAMES, SOLID, is_ours

# of what is no method; Okabe and Ito 2008, without yellow, which is too pale for a line
COLOURS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
DASHES = {SOLID: "-", DASHED: "--", DOTTED: (0, (1, 1)), MIXED: "-."}
CROWDED = 8  # methods, beyond which a legend needs a side of its own
HANDLE, LETTER = 0.6, 0.065  # inches, of a line in a legend and of what is written beside it
STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "0.9",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "lines.linewidth": 1.8,
    "figure.dpi": 100,
    "savefig.dpi": 150,
    "figure.constrained_layout.use": True,
}


@contextmanager
def figure(path: Path, rows: int, columns: int, size: tuple[float, float]) -> Iterator[tuple]:
    """A figure with rows x columns axes, (figure, axes), saved and closed at the end."""
    with plt.rc_context(STYLE):
        drawn: Figure
        drawn, axes = plt.subplots(rows, columns, figsize=size, squeeze=False)
        yield drawn, axes
        path.parent.mkdir(parents=True, exist_ok=True)
        drawn.savefig(path)
        plt.close(drawn)
        in_few_colours(path)


def in_few_colours(path: Path) -> None:
    """Writes a PNG again with 256 colours, which look alike, in two fifths of the bytes.

    None is far off: a median cut made the rare ones, such as a method's name beside pictures, grey.
    """
    with Image.open(path) as picture:
        few = picture.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=1)
    few.save(path, "png", optimize=True)


@contextmanager
def panels(
    path: Path, titles: Collection[str], abreast: int, size: tuple[float, float]
) -> Iterator[tuple]:
    """A figure with axes under titles, of a size each, in lines; the legend has room below."""
    columns = min(abreast, len(titles))
    rows = -(-len(titles) // columns)
    whole = max(6, size[0] * columns), size[1] * rows + 0.6
    with figure(path, rows, columns, whole) as (drawn, axes):
        for axis, title in zip_longest(axes.flat, titles):
            axis.set_title(title or "")
            axis.set_visible(title is not None)
        yield drawn, axes


def band(
    axis: Any, x: Any, quartiles: Any, look: dict, label: str = "", alpha: float = 0.15
) -> None:
    """A median as a line, and a band from the lower quartile to the upper, (3, x), unless clear."""
    low, middle, high = np.array(quartiles, float)  # None is NaN
    axis.plot(x, middle, label=label, **look)
    if alpha:
        axis.fill_between(x, low, high, color=look["color"], alpha=alpha, lw=0)


def headed(drawn: Figure, title: str) -> None:
    """What all axes are of."""
    drawn.suptitle(title, x=0.01, ha="left", fontsize=10)


def legend(drawn: Figure, handles: list, labels: list[str]) -> None:
    """Names the methods: below the axes or, where they are many, on the right of a wider figure."""
    if len(labels) > CROWDED:
        width, height = drawn.get_size_inches()
        drawn.set_size_inches(width + 3.5, max(height, 0.2 * len(labels) + 0.6))
        drawn.legend(handles, labels, loc="outside right center", handlelength=3.5)
    else:
        fitting = drawn.get_figwidth() / (HANDLE + LETTER * max(map(len, labels)))
        ncols = max(1, min(3, len(labels), int(fitting)))
        drawn.legend(handles, labels, loc="outside lower center", ncols=ncols)


def looks(names: Collection[str]) -> dict[str, dict]:
    """The line of each name: a method has its own in every figure, all else one in turn.

    Where there are many methods all lines are lost: those of ours are thick and on top then, the
    others thin.
    """
    spare = product(DASHES.values(), COLOURS)
    look = {}
    for name in names:
        if name in NAMES:
            look[name] = {"color": NAMES[name].colour, "linestyle": DASHES[NAMES[name].dash]}
        else:
            dash, colour = next(spare)
            look[name] = {"color": colour, "linestyle": dash}
    if len(look) > CROWDED:
        for name in filter(NAMES.get, look):
            look[name] |= {"linewidth": 2.6, "zorder": 3} if is_ours(name) else {"linewidth": 1.1}
    return look
