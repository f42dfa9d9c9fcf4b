"""The results as tables and as a picture."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import _style
from benchmarks._grid import Grid, Row
from benchmarks._names import is_ours, name_of
from benchmarks.studies.profiles.shares import PAIRS, POINTS, TAUS

DRAWN = ("0.001", PAIRS)  # levels; each panel has one of these
ABREAST = 4


def tables(results: dict[str, Any]) -> Iterator[Grid]:
    """Shares at some budgets, a table for each panel; and what did not run."""
    for panel in results["panels"]:
        yield _panel(panel, list(results["methods"]))
    if results["missing"]:
        rows = tuple(Row(who, (f"not able: {why}",)) for who, why in results["missing"].items())
        yield Grid("Did not run", "", ("", ""), rows, numbers=False)


def _panel(panel: dict[str, Any], methods: list[str]) -> Grid:
    rows = []
    for method in methods:
        of = [found[method]["at"] for found in panel["levels"].values() if method in found]
        shares = ("/".join(f"{100 * each:.0f}" for each in at) for at in zip(*of, strict=True))
        if of:
            failed = str(panel["failed"].get(method, ""))
            rows.append(Row(name_of(method), (*shares, failed), strong=is_ours(method)))
    what = f"problems solved to {'/'.join(map('{:g}'.format, TAUS))}, by exact values"
    if PAIRS in panel["levels"]:
        what = "pairs of a function and one of 51 targets from 100 to 1e-8 above the lowest value"
    budgets = (f"{budget} {_unit(panel)}" for budget in panel["budgets"])
    return Grid(
        title=f"{panel['title']}: {panel['problems']} problems, shares within budgets",
        caption=f"Percent of the {what}; and how many runs ended by an error.",
        columns=("method", *budgets, "failed"),
        rows=tuple(rows),
    )


def _unit(panel: dict[str, Any]) -> str:
    return f"(n + {panel['more']})" if panel["more"] else "n"


def draw(results: dict[str, Any], folder: Path) -> None:
    """The share that is solved, against evaluations; one panel for each kind."""
    look = _style.looks(results["methods"])
    panels = {panel["title"]: panel for panel in results["panels"]}
    if not panels:
        return
    with _style.panels(folder / "profiles.png", panels, ABREAST, (3, 2.5)) as (drawn, axes):
        for axis, panel in zip(axes.flat, panels.values(), strict=False):
            budgets = np.geomspace(1, panel["budgets"][-1], POINTS)
            for level in (level for level in DRAWN if level in panel["levels"]):
                for method, found in panel["levels"][level].items():
                    axis.step(budgets, found["curve"], where="post", **look[method])
            axis.set(xscale="log", ylim=(-0.02, 1.02), xlabel=f"Evaluations / {_unit(panel)}")
        for axis in axes[:, 0]:
            axis.set_ylabel("Share solved")
        handles = [axes[0, 0].plot([], [], **line)[0] for line in look.values()]
        _style.legend(drawn, handles, list(map(name_of, look)))
        _style.headed(drawn, "Problems solved to 0.001; of BBOB, pairs of function and target")
