"""Data profiles: the share of problems that are solved within a budget.

J. J. Moré, S. M. Wild: Benchmarking Derivative-Free Optimization Algorithms. SIAM Journal on
Optimization 20 (2009).
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks._summary import cost_to_level
from benchmarks.studies.profiles.problems import Case, Panel
from benchmarks.studies.profiles.runs import FAILED

TAUS = (1e-1, 1e-3, 1e-5)
PAIRS = "targets"  # the level of a panel that has targets
POINTS = 60  # of a curve

Runs = Mapping[str, Mapping[str, Any]]  # of a case, by method


def profile(panel: Panel, runs: Sequence[Runs]) -> dict[str, Any]:
    """What results.json says of a panel, of which each case has its runs."""
    costs: dict[str, dict[str, list[float]]] = {}
    for case, by_method in zip(panel.cases, runs, strict=True):
        for level, goal in goals(panel, case, by_method):
            for method, run in by_method.items():
                took = cost_to_level(run["values"], run["evaluations"], goal)
                into = costs.setdefault(level, {}).setdefault(method, [])
                into.append(took / panel.evaluations(case))
    grid = np.geomspace(1, panel.budgets[-1], POINTS)
    return {
        "set": panel.set,
        "title": panel.title,
        "problems": len(panel.cases),
        "more": panel.more,
        "budgets": list(panel.budgets),
        "failed": failed(runs),
        "levels": {
            level: {
                method: {"at": share(took, panel.budgets), "curve": share(took, grid)}
                for method, took in by_method.items()
            }
            for level, by_method in costs.items()
        },
    }


def failed(runs: Sequence[Runs]) -> dict[str, int]:
    """How many runs of each method ended by an error; what they had found counts."""
    ended = [(method, run["ended"]) for of in runs for method, run in of.items()]
    return Counter(method for method, how in ended if how.startswith(FAILED))


def goals(panel: Panel, case: Case, runs: Runs) -> Iterator[tuple[str, float]]:
    """Levels and the values to get down to; none where nobody gets below the start."""
    start = next((run["start"] for run in runs.values()), np.inf)
    found = [run["values"][-1] for run in runs.values() if len(run["values"])]
    best = min(found if case.lowest is None else [*found, case.lowest], default=start)
    if panel.targets:
        yield from ((PAIRS, (case.lowest or 0.0) + target) for target in panel.targets)
    elif best < start:
        yield from ((f"{tau:g}", best + tau * (start - best)) for tau in TAUS)


def share(costs: Sequence[float], budgets: Sequence[float] | np.ndarray) -> list[float]:
    """Of so many, how many cost no more than each budget; rounding is no reason to fail."""
    within = np.asarray(costs)[:, None] <= np.asarray(budgets)[None] * (1 + 1e-9)
    return within.mean(axis=0).tolist()
