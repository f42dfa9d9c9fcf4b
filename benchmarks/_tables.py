"""The results of a task as tables: what each level took, and what was left at the end."""

from collections.abc import Iterator
from itertools import product
from typing import Any

from benchmarks._grid import Grid, Row, short, spread
from benchmarks._names import name_of
from benchmarks._pictures import GAP, errors_of, names_of
from benchmarks._reached import machines, not_able, others, reached
from benchmarks._summary import COSTS, able

CAPTIONS = {
    "image_error": "On renders without noise, which are not charged.",
    "parameter_error": "Seconds are without compilation.",
    "gap": "It is absolute.",
}
MARK = "» "  # before what is ours, as a terminal may have no bold
COMPARED = "99"  # percent: the level at which runs are put beside the committed ones


def tables(results: dict[str, Any]) -> Iterator[Grid]:
    """All tables of a task, or of each task of a family and one of the family."""
    for task in results["tasks"].values():
        for error in errors_of(task):
            yield _took(task, error)
        yield _left(task)
    if _compared_by_gap(results):
        yield _family(results)


def ending(results: dict[str, Any]) -> tuple[list[Grid], list[str]]:
    """What a run ends with: the tables of those that got there, ours marked, and a few lines."""
    grids, lines = [], []
    for task in filter(able, results["tasks"].values()):
        grid = reached(task, brief=True)
        rows = (row._replace(name=MARK * row.strong + row.name) for row in grid.rows)
        if grid.rows:
            grids.append(grid._replace(rows=tuple(rows)))
        lines.append(others(task))
    if _compared_by_gap(results):
        grids.append(_family(results))
    lines += [say(task) for task in results["tasks"].values() for say in (not_able, machines)]
    return grids, list(dict.fromkeys(filter(None, lines)))


def _took(task: dict[str, Any], error: str) -> Grid:
    kind, unit = error.replace("_", " "), "" if error == "gap" else " %"
    names, rows = names_of({"": task}), []
    for method, found in able(task).items():
        name = names[method]
        for level, took in found["took"][error].items():
            there = f"{took['solved']}/{found['starts']}"
            rows.append(Row(name, (level + unit, there, *(spread(took[cost]) for cost in COSTS))))
            name = ""
        rows[-1] = rows[-1]._replace(end=True)
    return Grid(
        title=f"{task['title']}: reducing the {kind}",
        caption=f"Median [quartiles] over the starts; - is not reached. {CAPTIONS[error]}",
        columns=("method", "to" if error == "gap" else "reduction", "solved", *COSTS),
        rows=tuple(rows),
    )


def _left(task: dict[str, Any]) -> Grid:
    budget = task["budget"]
    rows = []
    for name, found in able(task).items():
        errors = [found["final"][error] for error in ("image_error", "parameter_error")]
        shown = (spread(each) for each in (*errors, found["distance"]))
        cells = (*shown, f"{found['warm_up_seconds']:.1f} s")
        rows.append(Row(name_of(name, found["title"]), cells))
    return Grid(
        title=f"At the end, after {budget['evaluations']} evaluations or {budget['seconds']:g} s",
        caption=f"Distance in units of the parameters, without compilation. {not_able(task)}",
        columns=("method", "image error", "parameter error", "distance", "compile"),
        rows=tuple(rows),
    )


def _compared_by_gap(results: dict[str, Any]) -> bool:
    """Whether it is a family whose lowest values are known."""
    tasks = results["tasks"].values()
    return len(tasks) > 1 and all("gap" in errors_of(task) for task in tasks)


def _family(results: dict[str, Any]) -> Grid:
    """Evaluations of each method on each task, where all have a lowest value."""
    tasks = results["tasks"]

    def cell(task: dict[str, Any], method: str) -> str:
        found = able(task).get(method)
        if found is None or "gap" not in found["took"]:
            return ""
        took = found["took"]["gap"][GAP]
        return f"{short(took['evaluations']['median'])} ({took['solved']}/{found['starts']})"

    return Grid(
        title=f"{results['title']}: evaluations to a gap of {GAP}",
        caption="Median over the starts; how many got there; - is no more than half.",
        columns=("method", *tasks),
        rows=tuple(
            Row(name, tuple(cell(task, method) for task in tasks.values()))
            for method, name in names_of(tasks).items()
        ),
    )


def compare(results: dict[str, Any], committed: dict[str, Any]) -> Iterator[Grid]:
    """What was run here beside what is in the repository."""
    for name, task in results["tasks"].items():
        theirs = able(committed["tasks"].get(name, {"methods": {}}))
        rows = []
        for method, found in able(task).items():
            pairs = product(COSTS, (found, theirs[method])) if method in theirs else ()
            if cells := tuple(_compared(each, cost) for cost, each in pairs):
                rows.append(Row(name_of(method, found["title"]), cells))
        yield Grid(
            title=f"{task['title']}: to {COMPARED} % of the image error, here and committed",
            caption=f"Committed: {committed['command']}, {committed['machine']['cpu']}. "
            "Median [quartiles] (how many starts got there).",
            columns=("method", *(f"{cost}, {who}" for cost in COSTS for who in ("here", "comm."))),
            rows=tuple(rows),
        )


def _compared(found: dict[str, Any], cost: str) -> str:
    took = found["took"]["image_error"][COMPARED]
    return f"{spread(took[cost])} ({took['solved']}/{found['starts']})"
