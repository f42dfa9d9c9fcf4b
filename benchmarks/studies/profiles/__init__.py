"""Data profiles: how many problems of CUTEst and of COCO's BBOB are solved within a budget.

Methods see residuals or numbers, exact, with noise, or rounded; the exact values are scored. A
budget counts in units of n + 1 evaluations, for BBOB of n. `python -m benchmarks profiles bbob5`
runs one of the sets: residuals, scalars, scalars50, held_out with other names, settings of models
of scikit-learn, and by the number of parameters bbob5, bbob10, bbob20 and, of COCO's large-scale
suite, bbob160. With `--jobs 16` sixteen processes share the runs.
"""

from argparse import Namespace
from pathlib import Path
from typing import Any

from benchmarks._task import NotAble, precision
from benchmarks.studies.profiles import ours, peers
from benchmarks.studies.profiles.kept import of_panel, side_by_side
from benchmarks.studies.profiles.problems import SETS
from benchmarks.studies.profiles.runs import Method
from benchmarks.studies.profiles.shares import profile
from benchmarks.studies.profiles.shown import draw, tables

HELP = "data profiles on CUTEst and BBOB, against other libraries"
OPTIONS = ("names", "full", "fresh", "methods", "jobs")
METHODS: dict[str, Method] = peers.METHODS | ours.METHODS


def measure(options: Namespace, folder: Path) -> dict[str, Any]:
    """The shares of all panels."""
    methods = chosen(METHODS, options.methods.split(",") if options.methods else [])
    sets = chosen(SETS, options.names)
    panels, missing = [], {}
    if options.jobs > 1:
        side_by_side([*sets], methods, options, folder)
        options = Namespace(**{**vars(options), "fresh": False})  # what they made is to be read
    with precision("float64"):
        for name, build in sets.items():
            try:
                for panel in build(options.full):
                    found = of_panel(panel, methods, missing, options, folder / "runs" / name)
                    if any(found):
                        panels.append(profile(panel, found))
            except NotAble as reason:
                missing[name] = str(reason)
    ran = {name: each for name, each in methods.items() if each.title not in missing}
    titles = {name: method.title for name, method in ran.items()}
    return {"methods": titles, "missing": missing, "panels": panels}


def chosen(found: dict[str, Any], names: list[str]) -> dict[str, Any]:
    """Those of the names, or all."""
    for name in (name for name in names if name not in found):
        raise SystemExit(f"There is no {name!r}; choose from {', '.join(found)}.")
    return {name: each for name, each in found.items() if name in names or not names}


__all__ = ["HELP", "OPTIONS", "draw", "measure", "tables"]
