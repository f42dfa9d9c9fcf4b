"""BOBYQA as in Py-BOBYQA: a trust region on quadratic interpolation. Its licence is the GPL.

Its restarts draw from NumPy's global random numbers, so that they are not tied to the key.
"""

import warnings

import numpy as np

from benchmarks._task import Solve, Task
from benchmarks.methods._flat import Flat, OneByOne, package

TITLE = "Py-BOBYQA"


def prepare(task: Task) -> Solve:
    """The first radius is sigma, if there is room; it restarts where its radius has shrunk."""
    pybobyqa = package("pybobyqa", "Py-BOBYQA")
    flat = Flat(task)
    low, high = np.asarray(flat.low, float), np.asarray(flat.high, float)
    radius = min(task.sigma, 0.49 * float(np.min(high - low)))

    def solve(y0, key, record):
        with warnings.catch_warnings(action="ignore"):  # singular systems, on plateaus
            pybobyqa.solve(
                OneByOne(flat, record),
                flat.start(y0),
                bounds=(low, high),
                rhobeg=radius,
                rhoend=1e-8 * radius,
                maxfun=2 * task.budget.evaluations,  # record ends it earlier
                user_params={"restarts.use_restarts": True},
                do_logging=False,
            )

    return solve
