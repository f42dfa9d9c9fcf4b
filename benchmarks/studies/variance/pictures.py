"""The results as pictures."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._style import COLOURS, figure, looks
from benchmarks.studies.variance.descent import LEVELS
from benchmarks.studies.variance.estimators import INGREDIENTS, PEERS

COSTS = {"evaluations": "Evaluations", "ms": "Milliseconds of a call"}
QUANTITIES = {"gradient": "Gradient", "hessian": "Hessian", "hvp": "Hessian-vector product"}


def draw(results: dict[str, Any], folder: Path) -> None:
    """A picture of each problem, of what the ingredients of ours give, and of the descent."""
    problems = results["problems"]
    for name, problem in problems.items():
        _problem(problem, folder / f"{name}.png")
    _ingredients({name: problems[name] for name in ("box2", "box10")}, folder / "ingredients.png")
    _descent(results["descent"], folder / "descent.png")


def _problem(problem: dict[str, Any], path: Path) -> None:
    """Error against evaluations above, against time below."""
    quantities = [q for q in QUANTITIES if q in problem["estimators"]["ours"]]
    with figure(path, 2, len(quantities), (3.2 * len(quantities) + 1, 6.2)) as (drawn, axes):
        for line, cost in zip(axes, COSTS, strict=True):
            for axis, quantity in zip(line, quantities, strict=True):
                _lines(axis, problem, PEERS, quantity, cost)
                axis.set_title(QUANTITIES[quantity])
        _finish(drawn, axes, min(4, 1 + len(quantities)))
        drawn.suptitle(problem["title"], x=0.01, ha="left", fontsize=10)


def _ingredients(boxes: dict[str, Any], path: Path) -> None:
    parts = ("gaussian-mean", "sobol-mean", *INGREDIENTS)
    with figure(path, 2, len(boxes), (3.6 * len(boxes) + 0.5, 6.2)) as (drawn, axes):
        for line, quantity in zip(axes, ("gradient", "hessian"), strict=True):
            for axis, (name, problem) in zip(line, boxes.items(), strict=True):
                _lines(axis, problem, parts, quantity, "evaluations")
                axis.set_title(f"{name.capitalize()}: {QUANTITIES[quantity].lower()}")
        _finish(drawn, axes, 3)


def _lines(axis: Any, problem: dict, names: Collection[str], quantity: str, cost: str) -> None:
    look = looks(names)
    for name in names:
        estimator = problem["estimators"].get(name, {})
        if quantity in estimator:
            title, curve = estimator["title"], estimator[quantity].values()
            taken = [at[cost] for at in curve]
            low, middle, high = np.array([at["rmse"] for at in curve]).T
            width = 2.6 if title.startswith("Ours") else 1.3
            axis.plot(taken, middle, label=title, lw=width, **look[name])
            axis.fill_between(taken, low, high, color=look[name]["color"], alpha=0.12, lw=0)
    axis.set(xscale="log", yscale="log", xlabel=COSTS[cost])


def _finish(drawn: Any, axes: np.ndarray, columns: int) -> None:
    """One legend for all axes, each line once."""
    found: dict[str, Any] = {}
    for axis in axes.flat:
        handles, labels = axis.get_legend_handles_labels()
        found |= dict(zip(labels, handles, strict=True))
    drawn.legend(found.values(), found, loc="outside lower center", ncols=columns, fontsize=8)
    for axis in axes[:, 0]:
        axis.set_ylabel("Relative RMSE")


def _descent(lines: list[dict[str, Any]], path: Path) -> None:
    with figure(path, 1, 1, (4.5, 3)) as (_, axes):
        axis = axes[0, 0]
        for line, colour in zip(lines, COLOURS, strict=False):
            evaluations, (low, middle, high) = line["curve"].values()
            axis.plot(evaluations, middle, color=colour, label=f"{line['credit']} credit")
            axis.fill_between(evaluations, low, high, color=colour, alpha=0.2, lw=0)
        for level in LEVELS.values():
            axis.axhline(level, color="0.6", lw=0.6, ls=":", zorder=0)
        axis.set(xscale="log", yscale="log", xlabel="Evaluations")
        axis.set(title="Texture: image error by Adam, relative to the start")
        axis.legend()
