"""A table as data, so that the page and the terminal show the same; and how numbers are shown."""

from typing import NamedTuple

from rich import box
from rich.markup import escape as escape_markup
from rich.table import Table


class Row(NamedTuple):
    """A row; `method` names the method whose line is drawn beside it, and `strong` stands out."""

    name: str
    cells: tuple[str, ...]
    method: str | None = None
    strong: bool = False
    end: bool = False  # of a section


class Grid(NamedTuple):
    """A table. The first column holds the names of the rows; text columns are not aligned right."""

    title: str
    caption: str
    columns: tuple[str, ...]
    rows: tuple[Row, ...]
    numbers: bool = True


def short(number: float | None) -> str:
    """Two digits, or a whole number; a dash for None and infinity."""
    if number is None or not abs(number) < float("inf"):
        return "-"
    return f"{number:.2g}" if abs(number) < 10 else f"{number:.0f}"


def spread(quartiles: dict[str, float | None]) -> str:
    """A median with its quartiles."""
    low, middle, high = (short(quartiles[name]) for name in ("lower", "median", "upper"))
    return middle if middle == low == high else f"{middle} [{low}, {high}]"


def to_rich(grid: Grid) -> Table:
    """For the terminal."""
    shown = Table(
        title=escape_markup(grid.title),
        caption=escape_markup(grid.caption),
        box=box.SIMPLE_HEAD,
        collapse_padding=True,
    )
    shown.add_column(grid.columns[0], no_wrap=True)
    for column in grid.columns[1:]:
        # no number loses its end where the terminal is narrow
        shown.add_column(column, justify="right" if grid.numbers else "left", overflow="fold")
    for row in grid.rows:
        cells = [escape_markup(cell) for cell in (row.name, *row.cells)]
        shown.add_row(*cells, style="bold" if row.strong else None, end_section=row.end)
    return shown
