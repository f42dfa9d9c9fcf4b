"""Table 2: how far the ablations are behind where ours has taken 95 % of the error away.

The paper compares after equal iterations; here it is after equal evaluations, as finite differences
have a step for hundreds of ours. Errors below a thousandth of the start's count as that: a program
of switches is often solved exactly, and nothing can be divided by zero. Where ours does not get to
95 % the end of the budget is what counts.
"""

from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group
from rich.table import Table

from benchmarks._harness import Run, run
from benchmarks._style import figure, legend, looks
from benchmarks._summary import band
from benchmarks._task import NotAble
from benchmarks.zerograds import _configurations as configurations
from benchmarks.zerograds import _show
from benchmarks.zerograds._setting import Setting, load

REACHED = 0.05  # of the error of the start
FLOOR = 1e-3  # of the error of the start
POINTS = 80  # of a curve
COLUMNS = 3  # of panels


def measure(setting: Setting, folder: Path, fresh: bool) -> dict[str, Any]:
    """Curves and ratios of each task, and the geometric means of the groups."""
    found = {}
    for name in setting.budgets:
        task = load(name, setting)
        ran = run(
            task,
            configurations.ablations(),
            setting.seeds,
            folder / "runs" / name,
            setting=setting.name,
            fresh=fresh,
        )
        runs = {method.name: each for method, each in ran.items()}
        found[name] = {"title": task.title, "parameters": configurations.size(task)}
        found[name] |= compare(runs, task.budget.evaluations)
    return {
        "starts": setting.seeds,
        "titles": {method.name: method.title for method in configurations.ablations()},
        "tasks": found,
        "groups": means(found),
        "paper": configurations.PAPER,
    }


def compare(runs: dict[str, list[Run] | NotAble], budget: int) -> dict[str, Any]:
    """Each method's curve and its error over ours, where the median of ours is first at 5 %."""
    able = {name: each for name, each in runs.items() if isinstance(each, list)}
    ours = able["ours"]
    points = np.unique(np.concatenate([each["evaluations"] for each in ours]))
    curve = band(ours, "image_error", "evaluations", points)[1]
    reached = bool((curve <= REACHED).any())
    at = points[np.argmax(curve <= REACHED)] if reached else budget
    grid = np.unique(np.geomspace(1, budget, POINTS).round().astype(int))
    errors = {
        name: band(each, "image_error", "evaluations", np.array([at]))[1].item()
        for name, each in able.items()
    }
    error = max(errors["ours"], FLOOR)
    return {
        "at": int(at),
        "reached": reached,
        "errors": errors,
        "ratios": {name: max(each, FLOOR) / error for name, each in errors.items()},
        "final": {
            name: float(np.median([one["image_error"][-1] for one in each]))
            for name, each in able.items()
        },
        "not_able": {name: str(each) for name, each in runs.items() if name not in able},
        "evaluations": grid.tolist(),
        "curves": {
            name: band(each, "image_error", "evaluations", grid).tolist()
            for name, each in able.items()
        },
    }


def means(tasks: dict[str, Any]) -> dict[str, dict[str, float]]:
    """Geometric means of the ratios over the tasks of a group, of those that a method can do."""
    found: dict[str, dict[str, float]] = {}
    for group, members in configurations.GROUPS.items():
        ratios = [tasks[name]["ratios"] for name in members if name in tasks]
        for method in dict.fromkeys(name for each in ratios for name in each):
            logs = [np.log(each[method]) for each in ratios if method in each]
            found.setdefault(group, {})[method] = float(np.exp(np.mean(logs)))
    return found


def tables(results: dict[str, Any]) -> Group:
    """The ratios of the tasks, and those of the groups beside the paper's."""
    return Group(_by_task(results), _by_group(results))


def _by_task(results: dict[str, Any]) -> Table:
    tasks = results["tasks"]
    shown = _show.table(
        "Error over that of ours, where ours has taken 95 % of it away; in brackets what is left "
        "at the end, in %",
        f"Medians over {results['starts']} starts. * ours does not get to 95 %: at the end of the "
        "budget. - not able.",
        "method",
        *tasks,
    )
    at = [f"{task['at']}{'' if task['reached'] else '*'}" for task in tasks.values()]
    shown.add_row("evaluations", *at, end_section=True)
    for name, title in results["titles"].items():
        cells = [
            f"{_show.times(task['ratios'][name])} ({_show.short(100 * task['final'][name])})"
            if name in task["ratios"]
            else "-"
            for task in tasks.values()
        ]
        shown.add_row(title, *cells)
    return shown


def _by_group(results: dict[str, Any]) -> Table:
    groups = results["groups"]
    shown = _show.table(
        "Geometric means of these ratios / those of the paper",
        "The paper has no number for tasks with many parameters, and other scenes.",
        "method",
        *groups,
    )
    for name, title in results["titles"].items():
        cells = []
        for group, found in groups.items():
            paper = results["paper"].get(group, {}).get(name)
            beside = "" if paper is None else f" / {_show.times(paper)}"
            cells.append((_show.times(found[name]) if name in found else "-") + beside)
        shown.add_row(title, *cells)
    return shown


def draw(results: dict[str, Any], folder: Path) -> None:
    """The curves of each task; a dotted line where the errors are compared."""
    tasks, titles = results["tasks"], results["titles"]
    look = looks(titles)
    rows = -(-len(tasks) // COLUMNS)
    with figure(folder / "ablations.png", rows, COLUMNS, (10, 2.6 * rows + 0.6)) as (drawn, axes):
        for axis in axes.flat[len(tasks) :]:
            axis.set_visible(False)
        for axis, (name, task) in zip(axes.flat, tasks.items(), strict=False):
            for method, curves in task["curves"].items():
                low, middle, high = np.maximum(curves, FLOOR)
                axis.plot(task["evaluations"], middle, **look[method])
                axis.fill_between(
                    task["evaluations"], low, high, color=look[method]["color"], alpha=0.12, lw=0
                )
            axis.axvline(task["at"], color="0.4", lw=0.8, ls=":")
            axis.axhline(REACHED, color="0.4", lw=0.8, ls=":")
            axis.set(xscale="log", yscale="log", title=f"{name}, {task['parameters']:,} parameters")
            axis.set_ylim(FLOOR / 1.3, 3)
        for axis in axes[:, 0]:
            axis.set_ylabel("Image error")
        for axis in axes[-1]:
            axis.set_xlabel("Evaluations")
        handles = [axes[0, 0].plot([], [], **look[name])[0] for name in titles]
        legend(drawn, handles, list(titles.values()))
