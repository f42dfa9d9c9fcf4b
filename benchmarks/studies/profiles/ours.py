"""Ours: `GaussNewton` on residuals, `NewtonCG` or the default on numbers, through a black box.

There is one black box for all functions of a shape, so that a solver is compiled once for each.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import smoothdiff as sd
from benchmarks.studies.profiles.runs import SEED, Method, Seen, Spent
from smoothdiff._default_solver import default_solver

ENDLESS = 2**31 - 1  # steps: what ends a run is the budget
LIBRARY = Path(sd.__file__).parent
FILES = (
    Path(__file__),
    LIBRARY / "_run.py",
    LIBRARY / "_default_solver.py",
    *sorted(LIBRARY.glob("_solvers/*.py")),
)
SOURCE = "".join(path.read_text() for path in FILES)


def gauss_newton(seen: Seen) -> None:
    _run(sd.least_squares, seen, _default(seen, residuals=True), max_steps=ENDLESS)


def newton_cg(seen: Seen) -> None:
    solver = _default(seen, residuals=False)
    _run(sd.minimise, seen, replace(solver, restarts=100), max_steps=ENDLESS)


def shortest_call(seen: Seen) -> None:
    _run(sd.minimise, seen, None, max_evaluations=seen.budget)


def _default(seen: Seen, residuals: bool) -> Any:
    """The solver of the shortest call, with its sigma."""
    start = jnp.asarray(seen.case.start)
    return default_solver(start, seen.case.bounds, None, residuals)


@cache
def _black_box(shape: tuple[int, ...]) -> SimpleNamespace:
    """Whatever is `current` as a function of JAX, and that is the same object for all of them."""
    box = SimpleNamespace(current=None)

    def call(x: np.ndarray) -> Any:
        return box.current(x)

    black = sd.black_box(call, jax.ShapeDtypeStruct(shape, np.float64), on_nonfinite="nan")
    box.fun = lambda y, args: black(y)
    return box


def _run(minimise: Any, seen: Seen, solver: Any, **limits: int) -> None:
    box, start = _black_box(seen.at_start.shape), jnp.asarray(seen.case.start)
    box.current = seen
    options = {"key": jax.random.key(SEED), "bounds": seen.case.bounds}
    try:
        result = minimise(box.fun, start, solver=solver, **options, **limits)
    except sd.MinimiseError:
        if seen.count < seen.budget:
            raise
        raise Spent from None
    if result.reason == "interrupted":
        raise KeyboardInterrupt


METHODS = {
    "gauss_newton": Method("Gauss-Newton (ours)", True, gauss_newton, SOURCE),
    "newton_cg": Method("Newton-CG (ours)", False, newton_cg, SOURCE),
    "shortest_call": Method("shortest call (ours)", False, shortest_call, SOURCE),
}
