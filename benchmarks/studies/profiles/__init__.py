"""Data profiles: how many problems of CUTEst and of COCO's BBOB are solved within a budget.

Methods see residuals or numbers, exact, with noise, or rounded; the exact values are scored. A
budget counts in units of n + 1 evaluations, for BBOB of n. `python -m benchmarks profiles bbob5`
runs one of the sets: residuals, scalars, bbob5, bbob10, bbob20 and, of COCO's large-scale suite,
bbob160, by the number of parameters. `--seeds` is how many instances of BBOB's functions. With
`--jobs 16` sixteen processes share the runs, each on one core.
"""

import multiprocessing
import os
import re
from argparse import Namespace
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import cache, partial
from itertools import product
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
OPTIONS = ("names", "full", "seeds", "fresh", "methods", "jobs")
METHODS: dict[str, Method] = peers.METHODS | ours.METHODS


def measure(options: Namespace, folder: Path) -> dict[str, Any]:
    """The shares of all panels."""
    methods = chosen(METHODS, options.methods.split(",") if options.methods else [])
    sets = chosen(SETS, options.names)
    panels, missing = [], {}
    if options.jobs > 1:
        side_by_side(sets, methods, options, folder)
        options = Namespace(**{**vars(options), "fresh": False})  # what they made is to be read
    with precision("float64"):
        for name, build in sets.items():
            try:
                for panel in build(options.full, options.seeds):
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
    cases = tqdm(panel.cases, desc=panel.title, unit="case")
    return [of_case(panel, case, methods, missing, options, folder) for case in cases]


def of_case(
    panel: Panel,
    case: Case,
    methods: dict[str, Method],
    missing: dict[str, str],
    options: Namespace,
    folder: Path,
) -> dict[str, Any]:
    """The runs of a case, made or kept."""
    found: dict[str, Any] = {}
    slug = re.sub(r"\W+", "-", panel.title.lower()).strip("-")
    budget, behaviour = panel.evaluations(case, panel.budgets[-1]), behaviour_of(case)
    for name, method in methods.items():
        if method.residuals != (panel.set == "residuals") or method.title in missing:
            continue
        path = folder / slug / f"{case.name}-{name}-{setting(options)}.npz"
        stale = fingerprint(behaviour, method.source, budget)
        try:
            found[name] = cached(path, stale, partial(trace, method, case, budget), options.fresh)
        except NotAble as reason:
            missing[method.title] = str(reason)
    return found


def side_by_side(
    sets: dict[str, Any], methods: dict[str, Method], options: Namespace, folder: Path
) -> None:
    """Makes all runs in processes that share them, so that they need only be read."""
    context = multiprocessing.get_context("spawn")
    with context.Manager() as manager, precision("float64"):
        cores = manager.Queue()
        for core in range(options.jobs):
            cores.put(core)
        with ProcessPoolExecutor(options.jobs, context, _take_core, (cores,)) as pool:
            jobs = [
                pool.submit(_one, place, method, options, folder)
                for name in sets
                for number, panel in enumerate(_built(name, options.full, options.seeds))
                for place in product([name], [number], range(len(panel.cases)))
                for method in methods
                if methods[method].residuals == (panel.set == "residuals")
            ]
            for job in tqdm(as_completed(jobs), total=len(jobs), unit="run"):
                job.result()


def _take_core(cores: Any) -> None:
    """Keeps this process to a core of its own, where the system can."""
    if hasattr(os, "sched_setaffinity"):
        there = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {there[cores.get() % len(there)]})


def _one(place: tuple[str, int, int], method: str, options: Namespace, folder: Path) -> None:
    """One run of a method, on a case of a panel of a set."""
    name, number, index = place
    with precision("float64"):
        panel = _built(name, options.full, options.seeds)[number]
        how = chosen(METHODS, [method])
        of_case(panel, panel.cases[index], how, {}, options, folder / "runs" / name)


@cache
def _built(name: str, full: bool, seeds: int | None) -> list[Panel]:
    """The panels of a set, none where what they need is not there."""
    try:
        return list(SETS[name](full, seeds))
    except NotAble:
        return []


def behaviour_of(case: Case) -> str:
    """Changes when the case does: its numbers, and what is at the start and is seen there."""
    seen = Seen(case, budget=1)
    told = case.start, case.width, case.bounds, case.kind.noisy
    return fingerprint(SEED, *told, seen.at_start, np.asarray(seen(case.start)))


__all__ = ["HELP", "OPTIONS", "draw", "measure", "tables"]
