"""One picture for each part: panels, and in them medians as lines and quartiles as bands."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._style import COLOURS, figure, legend

WIDE, TALL = 3.3, 2.8  # inches of a panel


@contextmanager
def panels(
    path: Path, shown: Mapping[str, Any], x: str, y: str, abreast: int = 4
) -> Iterator[list[tuple[Any, Any]]]:
    """An axis for each title and what it shows; below them is said what is in each."""
    columns = min(abreast, len(shown))
    rows = -(-len(shown) // columns)
    with figure(path, rows, columns, (WIDE * columns, TALL * rows + 0.6)) as (drawn, axes):
        for axis in axes[:, 0]:
            axis.set_ylabel(y)
        for axis in axes[-1]:
            axis.set_xlabel(x)
        for axis in axes.flat[len(shown) :]:
            axis.set_visible(False)
        for axis, title in zip(axes.flat, shown, strict=False):
            axis.set_title(title)
        yield list(zip(axes.flat, shown.values(), strict=False))
        legend(drawn, *axes[0, 0].get_legend_handles_labels())


def curves(
    axis: Any, x: Sequence[float], found: Mapping[str, Any], floor: float = -np.inf, **line: Any
) -> None:
    """By label, lower quartile, median and upper quartile at each x."""
    for colour, (label, quartiles) in zip(COLOURS, found.items(), strict=False):
        low, middle, high = np.maximum(quartiles, floor)
        axis.plot(x, middle, color=colour, label=label, **line)
        axis.fill_between(x, low, high, color=colour, alpha=0.15, lw=0)


def sized(tasks: dict[str, Any]) -> dict[str, Any]:
    """The tasks under titles that say how many parameters they have."""
    return {f"{name}, {task['parameters']:,} parameters": task for name, task in tasks.items()}
