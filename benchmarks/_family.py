"""A family of tasks, such as functions in several dimensions: tables and one picture for all.

What counts is the evaluations to the smallest gap, so each task of a family has an `optimum`.
"""

from itertools import groupby
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Group
from rich.table import Table

from benchmarks._style import figure, legend, looks
from benchmarks._summary import GAPS

LEVEL = min(GAPS, key=lambda name: GAPS[name])
SHARED = ("setting", "command", "machine")
COLUMNS = 4  # of tables and of panels
FEWEST = 5  # evaluations that are drawn


def summarise(title: str, members: list[dict[str, Any]]) -> dict[str, Any]:
    """What is written to the family's results.json: the scores of its tasks, without the traces."""
    return {
        "title": title,
        **{name: members[0][name] for name in SHARED},
        "tasks": {
            member["task"]: {k: v for k, v in member.items() if k not in SHARED}
            | {"methods": {name: _scores(found) for name, found in member["methods"].items()}}
            for member in members
        },
    }


def _scores(found: dict[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in found.items() if k != "runs"}


def _ran(task: dict[str, Any]) -> dict[str, Any]:
    """The methods that were able."""
    return {name: found for name, found in task["methods"].items() if "gap" in found}


def tables(results: dict[str, Any]) -> Group:
    """Evaluations of each method on each task, a few tasks a table."""
    tasks = list(results["tasks"].items())
    tables = range(0, len(tasks), COLUMNS)
    return Group(*(_table(results, dict(tasks[i : i + COLUMNS])) for i in tables))


def _table(results: dict[str, Any], tasks: dict[str, dict[str, Any]]) -> Table:
    shown = Table(
        title=f"{results['title']} ({results['setting']}): evaluations to a gap of {LEVEL}",
        caption="Median over the starts; how many got there; - is no more than half.",
        box=box.SIMPLE_HEAD,
    )
    shown.add_column("method")
    for name in tasks:
        shown.add_column(name, justify="right")
    for method, title in _titles(results).items():
        found = [_ran(task).get(method) for task in tasks.values()]
        shown.add_row(title, *("" if scores is None else _cell(scores) for scores in found))
    return shown


def _titles(results: dict[str, Any]) -> dict[str, str]:
    """The methods that ran on any of the tasks."""
    tasks = results["tasks"].values()
    return {name: found["title"] for task in tasks for name, found in _ran(task).items()}


def _cell(found: dict[str, Any]) -> str:
    reached = found["gap"]["levels"][LEVEL]
    median = reached["evaluations"]["median"]
    solved = f"{reached['solved']}/{found['starts']}"
    return f"{'-' if median is None else round(median)} ({solved})"


def draw(results: dict[str, Any], path: Path) -> None:
    """Evaluations against dimensions, a panel for each function."""
    titles = _titles(results)
    look = looks(titles)
    panels = groupby(results["tasks"].items(), key=lambda item: item[0].rpartition("-")[0])
    functions = [(name, [task for _, task in members]) for name, members in panels]
    columns = min(COLUMNS, len(functions))
    rows = -(-len(functions) // columns)
    most = max(task["budget"]["evaluations"] for task in results["tasks"].values())
    with figure(path, rows, columns, (max(6, 3 * columns), 2.8 * rows + 0.6)) as (drawn, axes):
        for axis in axes.flat[len(functions) :]:
            axis.set_visible(False)
        for axis, (function, tasks) in zip(axes.flat, functions, strict=False):
            for method in titles:
                ran = [task for task in tasks if method in _ran(task)]
                _line(axis, ran, method, look[method])
            dimensions = [task["dimensions"] for task in tasks]
            axis.set(xscale="log", yscale="log", ylim=(FEWEST, 1.5 * most), title=function)
            axis.set_xticks(dimensions, [f"{n}-D" for n in dimensions])
            axis.xaxis.minorticks_off()
        for axis in axes[:, 0]:
            axis.set_ylabel("Evaluations")
        handles = [axes[0, 0].plot([], [], marker="o", **look[name])[0] for name in titles]
        legend(drawn, handles, list(titles.values()))
        drawn.suptitle(
            f"{results['title']} ({results['setting']}): median evaluations to a gap of {LEVEL}\n"
            "Open: the budget, where no more than half of the starts got there",
            x=0.01,
            ha="left",
            fontsize=10,
        )


def _line(axis, tasks: list[dict[str, Any]], method: str, look: dict[str, Any]) -> None:
    """The medians of a method over the dimensions; open where there is none."""
    levels = [task["methods"][method]["gap"]["levels"][LEVEL] for task in tasks]
    medians = [level["evaluations"]["median"] for level in levels]
    reached = [
        (task["dimensions"], y) for task, y in zip(tasks, medians, strict=True) if y is not None
    ]
    missed = [
        (task["dimensions"], task["budget"]["evaluations"])
        for task, y in zip(tasks, medians, strict=True)
        if y is None
    ]
    axis.plot(*zip(*reached, strict=True) if reached else ([], []), marker="o", **look)
    axis.plot(
        *zip(*missed, strict=True) if missed else ([], []),
        marker="o",
        ls="none",
        mfc="none",
        color=look["color"],
    )
