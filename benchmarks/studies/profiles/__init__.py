"""Data profiles: how many problems of CUTEst and of COCO's BBOB are solved within a budget.

Methods see residuals or numbers, exact, with noise, or rounded; the exact values are scored. A
budget counts in units of n + 1 evaluations, for BBOB of n. `python -m benchmarks profiles bbob5`
runs one of the sets: residuals, scalars, bbob5, bbob10, bbob20 and, of COCO's large-scale suite,
bbob160, by the number of parameters.
"""

import re
from argparse import Namespace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks._cache import cached, fingerprint
from benchmarks._study import setting
from benchmarks._task import NotAble, precision
from benchmarks.studies.profiles import ours, peers
from benchmarks.studies.profiles.problems import SETS, Case, Panel
from benchmarks.studies.profiles.runs import SEED, Method, Seen, trace
from benchmarks.studies.profiles.shares import Runs, profile
from benchmarks.studies.profiles.shown import draw, tables

HELP = "data profiles on CUTEst and BBOB, against other libraries"
OPTIONS = ("names", "full", "fresh", "methods")
METHODS: dict[str, Method] = peers.METHODS | ours.METHODS


def measure(options: Namespace, folder: Path) -> dict[str, Any]:
    """The shares of all panels."""
    methods = chosen(METHODS, options.methods.split(",") if options.methods else [])
    sets = chosen(SETS, options.names)
    panels, missing = [], {}
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


def of_panel(
    panel: Panel,
    methods: dict[str, Method],
    missing: dict[str, str],
    options: Namespace,
    folder: Path,
) -> list[Runs]:
    """The runs of each case, of the methods that are for it; who is missing is noted."""
    found: list[Runs] = []
    slug = re.sub(r"\W+", "-", panel.title.lower()).strip("-")
    for case in tqdm(panel.cases, desc=panel.title, unit="case"):
        of_case: dict[str, Any] = {}
        budget, behaviour = panel.evaluations(case, panel.budgets[-1]), behaviour_of(case)
        for name, method in methods.items():
            if method.residuals != (panel.set == "residuals") or method.title in missing:
                continue
            path = folder / slug / f"{case.name}-{name}-{setting(options)}.npz"
            stale = fingerprint(behaviour, method.source, budget)
            try:
                make = partial(trace, method, case, budget)
                of_case[name] = cached(path, stale, make, options.fresh)
            except NotAble as reason:
                missing[method.title] = str(reason)
        found.append(of_case)
    return found


def behaviour_of(case: Case) -> str:
    """Changes when the case does: its numbers, and what is at the start and is seen there."""
    seen = Seen(case, budget=1)
    told = case.start, case.width, case.bounds, case.kind.noisy
    return fingerprint(SEED, *told, seen.at_start, np.asarray(seen(case.start)))


__all__ = ["HELP", "OPTIONS", "draw", "measure", "tables"]
