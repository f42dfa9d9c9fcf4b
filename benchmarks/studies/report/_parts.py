"""What the page shows beside the scenes: studies, descents and artificial problems, in parts.

A study that is named nowhere here comes last, so that none is forgotten.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import _descents, _registry
from benchmarks._grid import Grid, Row, short
from benchmarks._names import NAMES, Named, name_of
from benchmarks._pictures import GAP
from benchmarks._study import committed
from benchmarks._summary import able
from benchmarks.studies.profiles.shares import PAIRS
from benchmarks.studies.report import _chart

DRAWN = ("0.001", PAIRS)  # levels of the data profiles
LEFT_OUT = ("report",)


class Sub(NamedTuple):
    """What is folded: a title and its tables."""

    title: str
    grids: list[Grid]
    command: str = ""
    open: bool = False


class Part(NamedTuple):
    key: str
    title: str
    subs: list[Sub]
    charts: Sequence[_chart.Chart] = ()
    legend: Sequence[Named] = ()


# by key: the title, and what is in it: studies, "descents" or "functions"
PARTS = {
    "ablations": ("Ablations", ("variance", "grey", "descents")),
    "savings": ("Savings", ("savings", "overhead", "filters")),
    "robustness": ("Robustness", ("robustness", "noise", "defaults")),
    "profiles": ("Artificial problems and data profiles", ("functions", "profiles")),
    "papers": ("The papers’ tables", ("zerograds",)),
    "stress": ("Stress", ("stress",)),
}


def parts(results: Path) -> Iterator[Part]:
    """Those of which there are results."""
    named = {name for _, names in PARTS.values() for name in names}
    rest = [name for name in _registry.studies() if name not in (*named, *LEFT_OUT)]
    for key, (title, names) in (PARTS | {"others": ("Other studies", tuple(rest))}).items():
        subs = [sub for name in names for sub in _subs(name, results)]
        charts, lines = _profiles(results) if key == "profiles" else ([], [])
        if subs:
            yield Part(key, title, subs, charts, lines)


def _subs(name: str, results: Path) -> Iterator[Sub]:
    if name == "functions":
        grid = _functions(results)
        if grid is not None:
            yield Sub("Artificial problems: evaluations", [grid], open=True)
    elif name == "descents":
        for task, entry in _registry.tasks().items():
            found = committed(task, results)
            if entry.kind == "descent" and found is not None:
                title = f"Filters of gradients: {entry.title}"
                yield Sub(title, list(_descents.tables(found)), found["command"])
    elif name in _registry.studies() and (found := committed(name, results)) is not None:
        study = _registry.studies()[name]
        title = f"{name.capitalize()}: {study.HELP}"
        yield Sub(title, list(study.tables(found)), found["command"])


def _functions(results: Path) -> Grid | None:
    """A line for each artificial problem; None where none was run."""
    found = {
        member: task
        for name, entry in _registry.tasks().items()
        if entry.kind == "function" and (of := committed(name, results)) is not None
        for member, task in of["tasks"].items()
    }
    ran = {name for task in found.values() for name in able(task)}
    methods = [name for name in NAMES if name in ran]
    if not methods:
        return None
    rows = []
    for member, task in found.items():
        level = f"gap {GAP}" if _has_gap(task) else "99 %"
        cells = (_cell(able(task).get(name)) for name in methods)
        rows.append(Row(f"{member}, {task['dimensions']}-D, to {level}", tuple(cells)))
    return Grid(
        title="Artificial problems: evaluations to 99 % of the parameter error, or to a gap",
        caption="Medians (how many starts got there, of how many); - is no more than half of them.",
        columns=("problem", *map(name_of, methods)),
        rows=tuple(rows),
    )


def _has_gap(task: dict[str, Any]) -> bool:
    return any("gap" in found["took"] for found in able(task).values())


def _cell(found: dict[str, Any] | None) -> str:
    if found is None:
        return ""
    took = found["took"]
    level = took["gap"][GAP] if "gap" in took else took["parameter_error"]["99"]
    return f"{short(level['evaluations']['median'])} ({level['solved']}/{found['starts']})"


def _profiles(results: Path) -> tuple[list[_chart.Chart], list[Named]]:
    found = committed("profiles", results)
    if found is None:
        return [], []
    charts = [
        _chart.of_profile(panel, level)
        for panel in found["panels"]
        for level in DRAWN
        if level in panel["levels"]
    ]
    return charts, [NAMES[name] for name in found["methods"]]
