"""Least squares of other libraries, for problems that have residuals: an evaluation is all of them.

DFO-LS is a trust region on linear models of the residuals; its licence is the GPL. It is told, or
not, that there is noise: then it restarts. SciPy's is a trust-region Gauss-Newton on differences.
"""

import warnings
from functools import partial
from typing import Any

import jax
import numpy as np

from benchmarks._task import MethodEntry, NotAble, Problem, Record, Solve
from benchmarks.methods._flat import Flat, package

STEP = 1.0  # of differences, in units of sigma: with SciPy's own no plateau is seen beyond


class Seen:
    """The residuals of NumPy's vector, recorded after each evaluation: the best point so far."""

    def __init__(self, flat: Flat, rows, record: Record):
        self._flat, self._rows, self._record = flat, rows, record
        self._lowest, self._best = np.inf, None

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Evaluates one point."""
        rows = np.asarray(self._rows(np.asarray(x, self._flat.dtype)), float)
        value = float(np.sum(rows**2))
        if self._best is None or value < self._lowest:
            self._lowest, self._best = value, self._flat.tree(x)
        self._record(self._best)
        return rows


def _compiled(problem: Problem) -> tuple[Flat, jax.stages.Wrapped]:
    residuals = problem.residuals
    if residuals is None:
        raise NotAble("this task has no residuals")
    flat = Flat(problem)
    return flat, jax.jit(lambda x: residuals(flat.tree(x)).ravel())


def dfo_ls(problem: Problem, *, noise: bool, first: float = 1.0) -> Solve:
    """The first radius is in units of sigma, if there is room within the bounds."""
    dfols = package("dfols", "DFO-LS")
    flat, rows = _compiled(problem)
    low, high = flat.box
    radius = min(first * problem.sigma, 0.49 * float(np.min(high - low)))

    def solve(y0, key, record):
        with warnings.catch_warnings(action="ignore"):
            dfols.solve(
                Seen(flat, rows, record),
                flat.start(y0),
                bounds=(low, high),
                rhobeg=radius,
                rhoend=1e-8 * radius,
                maxfun=2 * problem.budget.evaluations,  # record ends it earlier
                objfun_has_noise=noise,
                do_logging=False,
            )

    return solve


def least_squares(problem: Problem, *, step: float = STEP) -> Solve:
    """On differences that wide, in units of sigma, into the room that the bounds leave."""
    from scipy import optimize

    flat, rows = _compiled(problem)
    low, high = flat.box
    width = step * problem.sigma

    def solve(y0, key, record):
        seen = Seen(flat, rows, record)
        last: dict[bytes, np.ndarray] = {}

        def fun(x: np.ndarray) -> np.ndarray:
            value = seen(x)
            last.clear()
            last[x.tobytes()] = value
            return value

        def slopes(x: np.ndarray) -> np.ndarray:
            here = last[x.tobytes()] if x.tobytes() in last else seen(x)
            sides = np.diag(np.where(x + width <= high, width, -width))
            return np.stack([(seen(x + side) - here) / side.sum() for side in sides], axis=1)

        search: Any = optimize.least_squares  # its jac may be a function
        search(fun, flat.start(y0), slopes, bounds=(low, high))

    return solve


KINDS = ("scene", "program", "function")
METHODS = {
    "dfo_ls": MethodEntry(
        "DFO-LS on residuals", KINDS, partial(dfo_ls, noise=False), {"first": (0.5, 1.0, 2.0)}
    ),
    "dfo_ls_noise": MethodEntry(
        "DFO-LS on residuals, told of noise",
        KINDS,
        partial(dfo_ls, noise=True),
        {"first": (0.5, 1.0, 2.0)},
    ),
    "least_squares": MethodEntry(
        "least_squares on residuals (SciPy)", KINDS, least_squares, {"step": (0.25, 0.5, 1.0)}
    ),
}
