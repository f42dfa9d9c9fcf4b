"""Simulators with known answers, as a user has them: ours against other libraries, in evaluations.

Each is given in unit coordinates within its box, from random starts. Residuals are what it returns
less what it returns at the answer. Methods for residuals see these, the others the sum of their
squares. None of them is told anything else. A run is scored by the sum of squares over that at its
start.
"""

import math
from argparse import Namespace
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks import _style
from benchmarks._cache import cached, fingerprint
from benchmarks._grid import Grid, Row, short
from benchmarks._names import name_of
from benchmarks._summary import cost_to_level
from benchmarks._task import NotAble, precision
from benchmarks.studies.profiles import METHODS, chosen
from benchmarks.studies.profiles.kept import behaviour_of
from benchmarks.studies.profiles.problems import Case
from benchmarks.studies.profiles.runs import Method, trace
from benchmarks.studies.simulators.programs import SIMULATORS, Simulator

HELP = "ten simulators with known answers, against other libraries"
OPTIONS = ("names", "full", "seeds", "fresh", "methods")
STARTS = {False: 2, True: 10}
BUDGET = 400  # evaluations
WIDTH = 0.1  # of the box: where other libraries begin
LEVELS = ("0.01", "0.0001")  # of the loss at the start
# those that run where none are named
FIRST = (
    *("gauss_newton", "newton_cg", "dfo_ls", "dfo_ls_noise", "least_squares"),
    *("py_bobyqa", "nelder_mead", "bipop_cma_es"),
)


def measure(options: Namespace, folder: Path) -> dict[str, Any]:
    """What each method takes on each simulator, from each start."""
    asked = options.methods.split(",") if options.methods else [*FIRST]
    methods: dict[str, Method] = chosen(METHODS, asked)
    simulators: dict[str, Simulator] = chosen(SIMULATORS, options.names)
    seeds = range(options.seeds or STARTS[options.full])
    missing: dict[str, str] = {}
    found: dict[str, dict[str, Any]] = {}
    with precision("float64"):
        for name, simulator in tqdm(simulators.items(), unit="simulator"):
            found[name] = {}
            for method in (n for n in methods if n not in missing):
                kept = folder / "runs" / name / method
                try:
                    runs = [
                        made(methods[method], simulator, seed, kept, options.fresh)
                        for seed in seeds
                    ]
                    found[name][method] = scored(runs)
                except NotAble as reason:
                    missing[method] = str(reason)
    titles = {name: simulator.title for name, simulator in simulators.items()}
    ran = [name for name in methods if name not in missing]
    return {
        "budget": BUDGET,
        "starts": len(seeds),
        "titles": titles,
        "methods": ran,
        "missing": missing,
        "simulators": {name: {m: each[m] for m in ran} for name, each in found.items()},
    }


def case_of(simulator: Simulator, seed: int, residuals: bool) -> Case:
    """The problem in unit coordinates, from a start within the box."""
    low, high = np.array(simulator.low, float), np.array(simulator.high, float)
    wanted = simulator.run(np.array(simulator.truth, float))

    def off(u: np.ndarray) -> np.ndarray:
        return simulator.run(low + (high - low) * np.clip(u, 0, 1)) - wanted

    fun = off if residuals else lambda u: float(np.sum(off(u) ** 2))
    n = len(low)
    start = np.random.default_rng(seed).uniform(0.05, 0.95, n)
    box = np.zeros(n), np.ones(n)
    return Case(f"{simulator.title}-{seed}", fun, start, WIDTH, box, 0.0)


def made(how: Method, simulator: Simulator, seed: int, folder: Path, fresh: bool) -> dict[str, Any]:
    """A run that is kept, and made again if the method or the simulator changed."""
    case = case_of(simulator, seed, how.residuals)
    stale = fingerprint(behaviour_of(case), how.source, BUDGET)
    return cached(folder / f"{seed}.npz", stale, partial(trace, how, case, BUDGET), fresh)


def scored(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Evaluations to each level and in all, infinite where it is not reached."""
    shares = [np.asarray(each["values"], float) / each["start"] for each in runs]
    to = lambda level: [
        cost_to_level(share, each["evaluations"], float(level))
        for share, each in zip(shares, runs, strict=True)
    ]
    return {
        "to": {level: to(level) for level in LEVELS},
        "count": [each["count"] for each in runs],
    }


def tables(results: dict[str, Any]) -> Iterator[Grid]:
    """A row for each simulator, for each level a table; who solved how many, and when runs end."""
    methods, starts = results["methods"], results["starts"]
    for level in LEVELS:
        rows = [
            Row(title, tuple(cell(results["simulators"][name][m]["to"][level]) for m in methods))
            for name, title in results["titles"].items()
        ]
        rows[-1] = rows[-1]._replace(end=True)
        there = (str(len(reached(results, m, level)[1])) for m in methods)
        rows.append(Row(f"solved, of {starts * len(results['titles'])}", tuple(there)))
        each = list(results["simulators"].values())
        ends = (np.median([count for of in each for count in of[m]["count"]]) for m in methods)
        rows.append(Row("evaluations until the end", tuple(map(short, map(float, ends)))))
        yield Grid(
            title=f"Evaluations until {100 * float(level):g} % of the loss at the start is left",
            caption=f"Medians of {starts} starts, in brackets how many got there, if not all; - is "
            f"no more than half. At most {results['budget']} evaluations.",
            columns=("simulator", *map(name_of, methods)),
            rows=tuple(rows),
        )
    if results["missing"]:
        rows = tuple(Row(name_of(who), (why,)) for who, why in results["missing"].items())
        yield Grid("Did not run", "", ("", ""), rows, numbers=False)


def cell(took: list[float | None]) -> str:
    """A median, in brackets how many got there; None is infinity."""
    there = sum(each is not None for each in took)
    if 2 * there <= len(took):
        return f"- ({there})"
    middle = np.quantile([math.inf if t is None else t for t in took], 0.5, method="higher")
    return short(float(middle)) + (f" ({there})" if there < len(took) else "")


def reached(results: dict[str, Any], method: str, level: str) -> tuple[int, list[float]]:
    """How many runs there are, and what those took that got there, in order."""
    runs = [took for of in results["simulators"].values() for took in of[method]["to"][level]]
    return len(runs), sorted(took for took in runs if took is not None)


def draw(results: dict[str, Any], folder: Path) -> None:
    """The share of all runs that got there, against evaluations."""
    look = _style.looks(results["methods"])
    titles = [f"{100 * float(level):g} % of the loss left" for level in LEVELS]
    with _style.panels(folder / "simulators.png", titles, 2, (4, 3)) as (drawn, axes):
        for axis, level in zip(axes.flat, LEVELS, strict=True):
            for method, line in look.items():
                took, there = reached(results, method, level)
                at = np.concatenate([[1], there, [results["budget"]]])
                share = np.concatenate([[0], np.arange(1, len(there) + 1), [len(there)]])
                axis.step(at, share / took, where="post", **line)
            axis.set(xscale="log", ylim=(-0.02, 1.02), xlabel="Evaluations")
        axes[0, 0].set_ylabel("Share of runs")
        handles = [axes[0, 0].plot([], [], **line)[0] for line in look.values()]
        _style.legend(drawn, handles, list(map(name_of, look)))
        _style.headed(drawn, "Ten simulators from random starts")


__all__ = ["HELP", "OPTIONS", "draw", "measure", "tables"]
