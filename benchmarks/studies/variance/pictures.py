"""The results as pictures."""

from collections.abc import Collection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks._style import COLOURS, band, figure, headed, looks
from benchmarks.studies.variance.descent import LEVELS
from benchmarks.studies.variance.estimators import INGREDIENTS, PEERS

COSTS = {"evaluations": "Evaluations", "ms": "Milliseconds of a call"}
QUANTITIES = {"gradient": "Gradient", "hessian": "Hessian", "hvp": "Hessian-vector product"}


class Panel(NamedTuple):
    """Errors of a quantity on a problem against what they cost."""

    title: str
    estimators: dict[str, Any]
    quantity: str
    cost: str


def draw(results: dict[str, Any], folder: Path) -> None:
    """A picture of each problem, of what the ingredients of ours give, and of the descent."""
    found = {name: problem["estimators"] for name, problem in results["problems"].items()}
    for name, of in found.items():
        known = [quantity for quantity in QUANTITIES if quantity in of["ours"]]
        panels = [Panel(QUANTITIES[q], of, q, cost) for cost in COSTS for q in known]
        title = results["problems"][name]["title"]
        _errors(panels, len(known), PEERS, folder / f"{name}.png", title)
    panels = [
        Panel(f"{name.capitalize()}: {QUANTITIES[q].lower()}", found[name], q, "evaluations")
        for q in ("gradient", "hessian")
        for name in ("box2", "box10")
    ]
    parts = ("gaussian-mean", "sobol-mean", *INGREDIENTS)
    _errors(panels, 2, parts, folder / "ingredients.png")
    _descent(results["descent"], folder / "descent.png")


def _errors(
    panels: list[Panel], abreast: int, names: Collection[str], path: Path, title: str = ""
) -> None:
    """Of the named estimators, two rows of panels; one legend for all, each line once."""
    look, shown = looks(names), {}
    with figure(path, 2, abreast, (3.2 * abreast + 1, 6.2)) as (drawn, axes):
        for axis, panel in zip(axes.flat, panels, strict=True):
            for name in names:
                estimator = panel.estimators.get(name, {})
                if panel.quantity in estimator:
                    label, curve = estimator["title"], estimator[panel.quantity].values()
                    line = look[name] | {"lw": 2.6 if label.startswith("Ours") else 1.3}
                    taken = [at[panel.cost] for at in curve]
                    band(axis, taken, np.transpose([at["rmse"] for at in curve]), line, label, 0.12)
            axis.set(xscale="log", yscale="log", xlabel=COSTS[panel.cost], title=panel.title)
            handles, labels = axis.get_legend_handles_labels()
            shown |= dict(zip(labels, handles, strict=True))
        for axis in axes[:, 0]:
            axis.set_ylabel("Relative RMSE")
        ncols = min(4, 1 + abreast)
        drawn.legend(shown.values(), shown, loc="outside lower center", ncols=ncols, fontsize=8)
        headed(drawn, title)


def _descent(lines: list[dict[str, Any]], path: Path) -> None:
    with figure(path, 1, 1, (4.5, 3)) as (_, axes):
        axis = axes[0, 0]
        for line, colour in zip(lines, COLOURS, strict=False):
            costs, errors = line["curve"].values()
            band(axis, costs, errors, {"color": colour}, f"{line['credit']} credit", 0.2)
        for level in LEVELS.values():
            axis.axhline(level, color="0.6", lw=0.6, ls=":", zorder=0)
        axis.set(xscale="log", yscale="log", xlabel="Evaluations")
        axis.set(title="Texture: image error by Adam, relative to the start")
        axis.legend()
