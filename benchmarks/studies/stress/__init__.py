"""What a library of derivatives must survive.

Each case is a function that yields checks: what was looked at, what it may be at most, and what it
was. They are also tests.
"""

from argparse import Namespace
from collections.abc import Callable, Iterable, Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._grid import Grid
from benchmarks.studies._listed import dots, listed
from benchmarks.studies.stress import faults, memory, scales, shapes, simulator
from benchmarks.studies.stress._check import Check

HELP = "stiff and extreme cases: expected, seen, verdict"
OPTIONS = ()
CASES: dict[str, Callable[[], Iterable[Check]]] = {
    "f + 1e6": scales.offset,
    "1e-30 f and 1e30 f": scales.scale,
    "sigma from 1e-6 to 1e3": scales.width,
    "sigmas over 8 decades": scales.decades,
    "plateaus and kinks": shapes.plateaus,
    "stiff quadratics": shapes.stiff,
    "Rosenbrock": shapes.rosenbrock,
    "any definiteness": shapes.definiteness,
    "negated Gaussian": shapes.negated_gaussian,
    "the same, as in the paper": shapes.appendix_h,
    "stiff oscillator": simulator.oscillator,
    "a million parameters": memory.million,
    "weights in high dimension": faults.log_weights,
    "10 % of samples lost": faults.holes,
}


def measure(options: Namespace, folder: Path) -> dict[str, Any]:
    """The checks of all cases."""
    return {
        "cases": {
            name: {
                "about": (case.__doc__ or "").strip(),
                "checks": [check._asdict() | {"holds": check.holds} for check in case()],
            }
            for name, case in CASES.items()
        }
    }


def _alike(results: dict[str, Any]) -> Iterator[tuple[str, list[dict]]]:
    """The checks of each case that expect the same, with the name of the case."""
    expects = lambda check: (check["unit"], check["limit"])
    for name, case in results["cases"].items():
        for _, group in groupby(sorted(case["checks"], key=expects), expects):
            yield name, list(group)


def _ratio(check: dict[str, Any]) -> float:
    """What was seen over what it may be at most; what is no number is the worst."""
    seen, limit = check["seen"], check["limit"]
    if limit == 0:
        return 0.0 if check["holds"] else np.inf
    return np.inf if seen is None else seen / limit


def tables(results: dict[str, Any]) -> Iterator[Grid]:
    """A line for each expectation of a case."""
    lines = []
    for name, checks in _alike(results):
        worst = max(checks, key=_ratio)
        failing = sum(not check["holds"] for check in checks)
        expected = f"at most {worst['limit']:g} {worst['unit']}"
        line = {"case": name, "expected": expected, "seen": worst["seen"], "where": worst["what"]}
        verdict = f"{failing} of {len(checks)} fail" if failing else f"holds, {len(checks)} checks"
        lines.append(line | {"verdict": verdict})
    caption = "Seen is the worst of all checks with this expectation."
    yield listed("Stress", caption, lines, numbers=False)


def draw(results: dict[str, Any], folder: Path) -> None:
    """All checks, each over its limit."""
    rows: dict[str, list[float]] = {}
    for name, checks in _alike(results):
        rows.setdefault(f"{name}: {checks[0]['unit']}", []).extend(map(_ratio, checks))
    dots(folder / "stress.png", rows, 1, "Seen over the most that it may be", (1e-6, 1e2))
