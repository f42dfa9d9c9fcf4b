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
from benchmarks._style import COLOURS, figure
from benchmarks.studies._listed import listed
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
    least, most = 1e-6, 1e2
    rows = list(_alike(results))
    with figure(folder / "stress.png", 1, 1, (8, 0.26 * len(rows) + 1)) as (_, axes):
        axis = axes[0, 0]
        for place, (_, checks) in enumerate(rows):
            ratios = np.clip([_ratio(check) for check in checks], least, most)
            colours = [COLOURS[1] if check["holds"] else COLOURS[0] for check in checks]
            axis.scatter(ratios, [place] * len(checks), s=16, c=colours, alpha=0.6, lw=0)
        axis.axvline(1, color="0.3", lw=0.8)
        names = [f"{name}: {checks[0]['unit']}" for name, checks in rows]
        axis.set(xscale="log", xlim=(least / 2, most * 2), ylim=(len(rows) - 0.4, -0.6))
        axis.set(yticks=range(len(rows)), yticklabels=names)
        axis.set(xlabel="Seen over the most that it may be")
