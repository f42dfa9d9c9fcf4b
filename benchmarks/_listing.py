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
    "One task: python -m benchmarks run occlusion; all scenes: python -m benchmarks run all.",
    "The page of what is committed: python -m benchmarks report. All commands: --help.",
)


def show() -> None:
    """Prints it."""
    console = Console()
    for kind, title in GROUPS.items():
        shown = Table(title=title, box=None, show_header=False, title_justify="left", pad_edge=True)
        for name, entry in _registry.tasks().items():
            if entry.kind == kind:
                shown.add_row(f"[bold]{name}[/bold]", escape(_traits(entry)), escape(entry.title))
        if shown.row_count:
            console.print(shown)
    shown = Table(title="Methods", box=None, show_header=False, title_justify="left")
    for method in _registry.methods():
        shown.add_row(
            method,
            f"{name_of(method)}{' (ours)' * is_ours(method)}",
            escape(_registry.method(method).title),
        )
    console.print(shown)
    for hint in HINTS:
        console.print(hint, highlight=False)


def _traits(entry: TaskEntry) -> str:
    """How many parameters it has, and whether there are plateaus."""
    if entry.traits is None:
        return ""
    sizes = ", ".join(f"{size:,}" for size in dict.fromkeys(entry.traits.parameters))
    return f"{sizes}{', plateaus' * entry.traits.plateaus}"
