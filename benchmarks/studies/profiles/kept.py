"""Runs of methods on the cases of a panel: kept, and made by processes that share them."""

import multiprocessing
import os
import re
from argparse import Namespace
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks._cache import cached, fingerprint
from benchmarks._study import setting
from benchmarks._task import NotAble, precision
from benchmarks.studies.profiles.problems import SETS, Case, Panel
from benchmarks.studies.profiles.runs import SEED, Method, Seen, trace
from benchmarks.studies.profiles.shares import Runs


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


def behaviour_of(case: Case) -> str:
    """Changes when the case does: its numbers, and what is at the start and is seen there."""
    seen = Seen(case, budget=1)
    told = case.start, case.width, case.bounds, case.kind.noisy
    return fingerprint(SEED, *told, seen.at_start, np.asarray(seen(case.start)))


def side_by_side(
    sets: list[str], methods: dict[str, Method], options: Namespace, folder: Path
) -> None:
    """Makes all runs in processes, each on one core, so that they need only be read."""
    context = multiprocessing.get_context("spawn")
    with context.Manager() as manager, precision("float64"):
        cores = manager.Queue()
        for core in range(options.jobs):
            cores.put(core)
        pool = ProcessPoolExecutor(options.jobs, context, _take_core, (cores,))
        # one method at a time, so that many processes share what takes long
        runs = [
            pool.submit(_make, name, number, index, {method: how}, options, folder)
            for name in sets
            for number, panel in enumerate(_panels(name, options.full))
            for index in range(len(panel.cases))
            for method, how in methods.items()
        ]
        try:
            for run in tqdm(as_completed(runs), total=len(runs), unit="run"):
                run.result()
        finally:  # after an error or Ctrl-C no other run begins
            pool.shutdown(cancel_futures=True)


def _make(
    name: str,
    number: int,
    index: int,
    methods: dict[str, Method],
    options: Namespace,
    folder: Path,
) -> None:
    """The runs of a case, by its index, of a panel of a set: cases are not sent to processes."""
    with precision("float64"):
        panel = _panels(name, options.full)[number]
        of_case(panel, panel.cases[index], methods, {}, options, folder / "runs" / name)


@cache
def _panels(name: str, full: bool) -> list[Panel]:
    """Those of a set, none where what they need is not there."""
    try:
        return list(SETS[name](full))
    except NotAble:
        return []


def _take_core(cores: Any) -> None:
    """Keeps this process to a core of its own, where the system can."""
    if hasattr(os, "sched_setaffinity"):
        there = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {there[cores.get() % len(there)]})
