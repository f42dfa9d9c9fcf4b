"""Results that are a list of lines: as a table, and as dots against what they may be at most."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._grid import Grid, Row
from benchmarks._style import COLOURS, figure


def listed(
    title: str, caption: str, lines: Sequence[Mapping[str, Any]], numbers: bool = True
) -> Grid:
    """The table; a mapping in a line, as of what only a picture shows, is left out."""
    shown = [{k: v for k, v in line.items() if not isinstance(v, dict)} for line in lines]
    rows = (tuple(map(_cell, line.values())) for line in shown)
    columns = tuple(shown[0]) if shown else ("",)
    return Grid(title, caption, columns, tuple(Row(r[0], r[1:]) for r in rows), numbers)


def dots(
    path: Path, rows: Mapping[str, Sequence[float]], most: float, label: str, span: tuple
) -> None:
    """A row of dots for each name, beside a line at what they may be at most.

    What is beyond the ends of the axis is drawn there. The axis is logarithmic if it is long.
    """
    with figure(path, 1, 1, (8, 0.26 * len(rows) + 1)) as (_, axes):
        axis = axes[0, 0]
        for place, values in enumerate(rows.values()):
            colours = [COLOURS[1] if value <= most else COLOURS[0] for value in values]
            shown = np.clip(values, *span)
            axis.hlines(place, shown.min(), shown.max(), color="0.8", lw=2, zorder=1)
            axis.scatter(shown, [place] * len(values), s=16, c=colours, alpha=0.6, lw=0)
        axis.axvline(most, color="0.3", lw=0.8)
        axis.set_xscale("log" if span[1] > 10 * span[0] else "linear")
        axis.set(xlim=(span[0] / 1.1, span[1] * 1.1), xlabel=label)
        axis.set(yticks=range(len(rows)), yticklabels=rows, ylim=(len(rows) - 0.4, -0.6))


def _cell(value: Any) -> str:
    """Of three numbers the one in the middle, with the others in brackets."""
    if isinstance(value, Sequence) and not isinstance(value, str):
        low, middle, high = map(_cell, value)
        return f"{middle} [{low}, {high}]"
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    return str(value)
