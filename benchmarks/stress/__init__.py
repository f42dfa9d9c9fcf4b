"""What a library of derivatives must survive: `python -m benchmarks stress`.

Each case is a function that yields checks: what was looked at, what it may be at most, and what it
was. The fast ones are also tests.
"""

import json
import time
from collections.abc import Callable, Iterable
from itertools import groupby
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks._style import COLOURS, figure
from benchmarks._summary import machine
from benchmarks.stress._check import Check
from benchmarks.stress.faults import holes, log_weights
from benchmarks.stress.memory import million
from benchmarks.stress.scales import decades, offset, scale, width
from benchmarks.stress.shapes import (
    appendix_h,
    definiteness,
    negated_gaussian,
    plateaus,
    rosenbrock,
    stiff,
)
from benchmarks.stress.simulator import oscillator

CASES: dict[str, Callable[[], Iterable[Check]]] = {
    "f + 1e6": offset,
    "1e-30 f and 1e30 f": scale,
    "sigma from 1e-6 to 1e3": width,
    "sigmas over 8 decades": decades,
    "plateaus and kinks": plateaus,
    "stiff quadratics": stiff,
    "Rosenbrock": rosenbrock,
    "any definiteness": definiteness,
    "negated Gaussian": negated_gaussian,
    "the same, as in the paper": appendix_h,
    "stiff oscillator": oscillator,
    "a million parameters": million,
    "weights in high dimension": log_weights,
    "10 % of samples lost": holes,
}
Row = tuple[str, list[Check]]


def main(folder: Path, cases: dict[str, Callable[[], Iterable[Check]]] = CASES) -> None:
    """Runs the cases, prints a table, and writes results.json and stress.png."""
    found: dict[str, list[Check]] = {}
    seconds = {}
    for name, case in cases.items():
        began = time.perf_counter()
        found[name] = list(case())
        seconds[name] = time.perf_counter() - began
    content = {
        "command": "python -m benchmarks stress",
        "machine": machine(),
        "cases": {
            name: {
                "about": (cases[name].__doc__ or "").strip(),
                "seconds": seconds[name],
                "checks": [check._asdict() | {"holds": check.holds} for check in checks],
            }
            for name, checks in found.items()
        },
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "results.json").write_text(json.dumps(content, indent=1) + "\n")
    rows = [(name, list(alike)) for name, checks in found.items() for alike in _alike(checks)]
    _draw(rows, folder / "stress.png")
    Console().print(_table(rows))


def _alike(checks: list[Check]) -> list[list[Check]]:
    """The checks of a case by what they expect."""
    key = lambda check: (check.unit, check.limit)
    return [list(group) for _, group in groupby(sorted(checks, key=key), key)]


def _ratio(check: Check) -> float:
    """What was seen over what it may be at most; NaN is the worst."""
    if check.limit == 0:
        return 0.0 if check.holds else np.inf
    return np.inf if np.isnan(check.seen) else check.seen / check.limit


def _table(rows: list[Row]) -> Table:
    shown = Table(title="Stress", caption="Seen is the worst of all checks with this expectation.")
    for column in ("case", "expected", "seen", "where", "verdict"):
        shown.add_column(column)
    last = None
    for name, checks in rows:
        worst = max(checks, key=_ratio)
        failing = sum(not check.holds for check in checks)
        verdict = f"{failing} of {len(checks)} fail" if failing else f"holds, {len(checks)} checks"
        expected = f"at most {worst.limit:g} {worst.unit}"
        title = "" if name == last else name
        shown.add_row(title, expected, f"{worst.seen:.2g}", worst.what, verdict)
        last = name
    return shown


def _draw(rows: list[Row], path: Path) -> None:
    least, most = 1e-6, 1e2
    with figure(path, 1, 1, (8, 0.26 * len(rows) + 1)) as (_, axes):
        axis = axes[0, 0]
        for place, (_, checks) in enumerate(rows):
            ratios = np.clip([_ratio(check) for check in checks], least, most)
            colours = [COLOURS[1] if check.holds else COLOURS[0] for check in checks]
            axis.scatter(ratios, [place] * len(checks), s=16, c=colours, alpha=0.6, lw=0)
        axis.axvline(1, color="0.3", lw=0.8)
        names = [f"{name}: {checks[0].unit}" for name, checks in rows]
        axis.set(xscale="log", xlim=(least / 2, most * 2), ylim=(len(rows) - 0.4, -0.6))
        axis.set(yticks=range(len(rows)), yticklabels=names)
        axis.set(xlabel="Seen over the most that it may be")


__all__ = ["CASES", "main"]
