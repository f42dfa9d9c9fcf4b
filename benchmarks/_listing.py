"""What there is, for the terminal: tasks in groups with a line each, and the methods."""

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from benchmarks import _registry
from benchmarks._names import is_ours, name_of
from benchmarks._task import Kind, TaskEntry

GROUPS: dict[Kind, str] = {
    "scene": "Scenes of few parameters",
    "large": "Scenes of many parameters",
    "network": "Networks in front of a renderer",
    "program": "Programs",
    "function": "Artificial problems",
    "descent": "Problems that come with gradients, for filters of them",
}
HINTS = (
    "Run one: python -m benchmarks run occlusion",
    "Run all scenes: python -m benchmarks run all",
    "The page of what is committed: python -m benchmarks report",
    "All commands: python -m benchmarks --help",
)


def show() -> None:
    """Prints it."""
    console = Console()
    for kind, title in GROUPS.items():
        rows = [
            (name, _traits(entry), entry.title.partition(": ")[2] or entry.title)
            for name, entry in _registry.tasks().items()
            if entry.kind == kind
        ]
        _group(console, title, rows)
    methods = [(n, f"{name_of(n)}{' (ours)' * is_ours(n)}") for n in _registry.methods()]
    _group(console, "Methods", methods)
    console.print()
    for hint in HINTS:
        console.print(hint, highlight=False)


def _group(console: Console, title: str, rows: list[tuple[str, ...]]) -> None:
    """A line for each, which is cut where the terminal is narrow."""
    if not rows:
        return
    console.print(f"\n[bold]{escape(title)}[/bold]", highlight=False)
    shown = Table(box=None, show_header=False)
    *facts, _ = zip(*rows, strict=True)
    for column in facts:
        shown.add_column(no_wrap=True, min_width=max(map(len, column)))
    shown.add_column(no_wrap=True, overflow="ellipsis")
    for row in rows:
        shown.add_row(*map(escape, row))
    console.print(shown, highlight=False)


def _traits(entry: TaskEntry) -> str:
    """How many parameters it has, and whether there are plateaus."""
    if entry.traits is None:
        return ""
    sizes = ", ".join(f"{size:,}" for size in dict.fromkeys(entry.traits.parameters))
    return f"{sizes}{', plateaus' * entry.traits.plateaus}"
