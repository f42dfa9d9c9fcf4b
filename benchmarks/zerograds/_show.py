"""What the tables of the parts have in common."""

from rich import box
from rich.table import Table


def table(title: str, caption: str, *columns: str) -> Table:
    """A table whose first column is text and the others numbers."""
    shown = Table(title=title, caption=caption, box=box.SIMPLE_HEAD, title_justify="left")
    for i, column in enumerate(columns):
        shown.add_column(column, justify="right" if i else "left", no_wrap=True)
    return shown


def times(ratio: float) -> str:
    """A ratio with the digits that it deserves."""
    return f"{ratio:.2f}" if ratio < 10 else f"{ratio:.0f}"


def short(number: float) -> str:
    """Two digits, or a whole number."""
    return f"{number:.2g}" if abs(number) < 10 else f"{number:.0f}"
