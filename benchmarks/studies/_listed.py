"""A table of results that are a list of lines: what a line calls its values are the columns."""

from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks._grid import Grid, Row


def listed(
    title: str, caption: str, lines: Sequence[Mapping[str, Any]], numbers: bool = True
) -> Grid:
    """The table; a mapping in a line, as of what only a picture shows, is left out."""
    shown = [{k: v for k, v in line.items() if not isinstance(v, dict)} for line in lines]
    rows = (tuple(map(_cell, line.values())) for line in shown)
    columns = tuple(shown[0]) if shown else ("",)
    return Grid(title, caption, columns, tuple(Row(r[0], r[1:]) for r in rows), numbers)


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
