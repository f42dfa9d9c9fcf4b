"""The results as pictures."""

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from benchmarks._style import COLOURS, figure, looks
from benchmarks.variance.descent import LEVELS
from benchmarks.variance.estimators import OURS

COSTS = {"evaluations": "Evaluations", "ms": "Milliseconds of a call"}
QUANTITIES = {"gradient": "Gradient", "hessian": "Hessian", "hvp": "Hessian-vector product"}
# what the pictures of the problems show; the ingredients of ours have a picture of their own
PEERS = (
    "optax",
    "uniform",
    "fr22",
    "eq23-shared",
    "eq23-independent",
    "importance",
    "aggregate",
    "aggregate-mean",
    "gaussian-mean",
    "sobol-mean",
    OURS,
    "local-gaussian-mean",
    "local-ours",
)
INGREDIENTS = (
    "gaussian",
    "gaussian-mean",
    "gaussian-gp",
    "orthogonal-mean",
    "orthogonal-gp",
    "importance-quasi",
    "aggregate-quasi-mean",
    "aggregate-quasi-gp",
    "sobol",
    "sobol-mean",
    "sobol-quadratic",
    "sobol-gp",
)


def draw(results: dict[str, Any], folder: Path) -> None:
    """Draws what there is to draw."""
    problems = results["problems"]
    for name, problem in problems.items():
        _problem(problem, folder / f"{name}.png")
    if boxes := [name for name in ("box2", "box10") if name in problems]:
        _ingredients(problems, boxes, folder / "ingredients.png")
    _descent(results["descent"], folder / "descent.png")
    for path in folder.glob("*.png"):
        # lines need few colours, and results are kept with the source
        Image.open(path).convert("RGB").quantize(96, dither=Image.Dither.NONE).save(path)


def _lines(axis: Any, estimators: dict[str, Any], names: tuple, quantity: str, cost: str) -> None:
    look = looks(names)
    for name in names:
        found = estimators.get(name, {}).get(quantity)
        if found is None:
            continue
        low, middle, high = np.array(found["rmse"]).T
        width = 2.6 if estimators[name]["title"].startswith("Ours") else 1.3
        axis.plot(found[cost], middle, label=estimators[name]["title"], lw=width, **look[name])
        axis.fill_between(found[cost], low, high, color=look[name]["color"], alpha=0.12, lw=0)
    axis.set(xscale="log", yscale="log", xlabel=COSTS[cost])


def _legend(drawn: Any, axes: np.ndarray, columns: int) -> None:
    """One legend for all axes, each line once."""
    found: dict[str, Any] = {}
    for axis in axes.flat:
        handles, labels = axis.get_legend_handles_labels()
        found |= dict(zip(labels, handles, strict=True))
    drawn.legend(found.values(), found, loc="outside lower center", ncols=columns, fontsize=8)


def _problem(problem: dict[str, Any], path: Path) -> None:
    """Error against evaluations above, against time below."""
    estimators = problem["estimators"]
    quantities = [q for q in QUANTITIES if any(q in found for found in estimators.values())]
    with figure(path, 2, len(quantities), (3.2 * len(quantities) + 1, 6.2)) as (drawn, axes):
        for line, cost in zip(axes, COSTS, strict=True):
            for axis, quantity in zip(line, quantities, strict=True):
                _lines(axis, estimators, PEERS, quantity, cost)
                axis.set_title(QUANTITIES[quantity])
            line[0].set_ylabel("Relative RMSE")
        _legend(drawn, axes, min(4, 1 + len(quantities)))
        drawn.suptitle(problem["title"], x=0.01, ha="left", fontsize=10)


def _ingredients(problems: dict[str, Any], boxes: list[str], path: Path) -> None:
    with figure(path, 2, len(boxes), (3.6 * len(boxes) + 0.5, 6.2)) as (drawn, axes):
        for line, quantity in zip(axes, ("gradient", "hessian"), strict=True):
            for axis, name in zip(line, boxes, strict=True):
                _lines(axis, problems[name]["estimators"], INGREDIENTS, quantity, "evaluations")
                axis.set_title(f"{name.capitalize()}: {QUANTITIES[quantity].lower()}")
            line[0].set_ylabel("Relative RMSE")
        _legend(drawn, axes, 3)


def _descent(descent: dict[str, Any], path: Path) -> None:
    with figure(path, 1, 1, (4.5, 3)) as (_, axes):
        axis = axes[0, 0]
        for (credit, found), colour in zip(descent.items(), COLOURS, strict=False):
            low, middle, high = found["error"]
            axis.plot(found["evaluations"], middle, color=colour, label=f"{credit} credit")
            axis.fill_between(found["evaluations"], low, high, color=colour, alpha=0.2, lw=0)
        for level in LEVELS.values():
            axis.axhline(level, color="0.6", lw=0.6, ls=":", zorder=0)
        axis.set(xscale="log", yscale="log", xlabel="Evaluations")
        axis.set(title="Texture: image error by Adam, relative to the start")
        axis.legend()
