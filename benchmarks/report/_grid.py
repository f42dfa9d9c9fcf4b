"""A table as data, so that the page and the terminal show the same."""

from html import escape
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


class Grid(NamedTuple):
    """A table. The first column holds the names of the rows; text columns are not aligned right."""

    title: str
    caption: str
    columns: tuple[str, ...]
    rows: tuple[Row, ...]
    numbers: bool = True


def to_rich(grid: Grid) -> Table:
    """For the terminal."""
    shown = Table(
        title=escape_markup(grid.title),
        caption=escape_markup(grid.caption),
        box=box.SIMPLE_HEAD,
    )
    shown.add_column(grid.columns[0])
    for column in grid.columns[1:]:
        shown.add_column(column, justify="right" if grid.numbers else "left")
    for row in grid.rows:
        cells = [escape_markup(cell) for cell in (row.name, *row.cells)]
        shown.add_row(*cells, style="bold" if row.strong else None)
    return shown


def to_html(grid: Grid, swatches: dict[str, str]) -> str:
    """For the page; wide tables scroll by themselves."""
    head = "".join(f"<th scope=col>{escape(column)}</th>" for column in grid.columns)
    body = "".join(_html_row(row, swatches) for row in grid.rows)
    kind = "numbers" if grid.numbers else "texts"
    return (
        f"<figure class=table><figcaption><b>{escape(grid.title)}.</b> {escape(grid.caption)}"
        f"</figcaption><div class=scroll><table class={kind}><thead><tr>{head}</tr></thead>"
        f"<tbody>{body}</tbody></table></div></figure>\n"
    )


def _html_row(row: Row, swatches: dict[str, str]) -> str:
    swatch = swatches.get(row.method or "", "")
    cells = "".join(f"<td>{escape(cell)}</td>" for cell in row.cells)
    kind = " class=ours" if row.strong else ""
    return f"<tr{kind}><th scope=row>{swatch}{escape(row.name)}</th>{cells}</tr>"
