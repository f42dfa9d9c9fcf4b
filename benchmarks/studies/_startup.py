"""What a run costs before its function does: CPU time to the first step, and of a second call.

`python -m benchmarks.studies._startup gauss_newton` measures one solver in a process of its own, as
compiled programs stay in a process, and prints JSON.
"""

import functools
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import smoothdiff as sd

PARAMETERS, RESIDUALS, PROCESSES = 10, 1000, 5
SOLVERS = {"gauss_newton": "GaussNewton", "newton_cg": "NewtonCG"}
# what differs between a first call and a second one
CHANGES = ("function", "sigma", "key", "budget")


def measured() -> list[dict[str, Any]]:
    """A line for each solver: medians over processes."""
    lines = []
    for name, title in SOLVERS.items():
        command = [sys.executable, "-m", "benchmarks.studies._startup", name]
        runs = [
            json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
            for _ in range(PROCESSES)
        ]
        seconds = {key: statistics.median(run[key] for run in runs) for key in runs[0]}
        lines.append({"solver": title} | {key: round(s, 3) for key, s in seconds.items()})
    return lines


def alone(name: str) -> dict[str, float]:
    """CPU seconds in this process, of all its threads."""
    start = jnp.full(PARAMETERS, 0.5)
    settings = {"function": 0, "sigma": 0.1, "key": 0, "budget": 60}
    first, local, end = _timed(name, start, settings)
    found = {"to the first step": first, "to the first local step": local, "to the end": end}
    for what in CHANGES:
        changed = settings | {what: 2 * settings[what] + 1}
        found[f"again, another {what}"] = _timed(name, start, changed)[0]
    return found


def _timed(name: str, start: jax.Array, settings: dict[str, Any]) -> tuple[float, float, float]:
    fun, run = _problem(name, settings["function"])
    solver = sd.GaussNewton if name == "gauss_newton" else sd.NewtonCG
    steps, before = [], time.process_time()

    def callback(_: sd.Record) -> None:
        steps.append(time.process_time() - before)

    key, budget = jax.random.key(settings["key"]), settings["budget"]
    sigma = settings["sigma"]
    run(fun, start, key=key, solver=solver(sigma), max_evaluations=budget, callback=callback)
    # the first points come before the local model
    points = PARAMETERS + 1 if name == "gauss_newton" else 2 * PARAMETERS + 1
    return steps[0], steps[points], time.process_time() - before


@functools.cache
def _problem(name: str, seed: int) -> tuple[Callable, Callable]:
    """Residuals from NumPy, or their squares."""
    rows = np.random.default_rng(seed).normal(size=(RESIDUALS, PARAMETERS)).astype(np.float32)

    def host(y: np.ndarray) -> np.ndarray:
        return rows @ y - 1 + np.sin(rows[:, 0] * y.sum())

    box = sd.black_box(host, jax.ShapeDtypeStruct((RESIDUALS,), jnp.float32))
    if name == "gauss_newton":
        return lambda y, _: box(y), sd.least_squares
    return lambda y, _: jnp.sum(box(y) ** 2), sd.minimise


if __name__ == "__main__":
    print(json.dumps(alone(sys.argv[1])))
