"""Simulated annealing as in SciPy's `dual_annealing`, with its own defaults.

Without its local search, which takes derivatives by differences that are zero on plateaus.
"""

import jax
import numpy as np
from scipy import optimize

from benchmarks._task import Solve, Task
from benchmarks.methods._flat import Flat, OneByOne

TITLE = "Simulated annealing (SciPy)"


def prepare(task: Task) -> Solve:
    """One evaluation at a time, within the bounds."""
    flat = Flat(task)
    bounds = np.stack([flat.low, flat.high], axis=1).astype(float)

    def solve(y0, key, record):
        optimize.dual_annealing(
            OneByOne(flat, record),
            bounds,
            x0=flat.start(y0),
            maxiter=2**31,  # record ends it
            maxfun=2**31,
            no_local_search=True,
            rng=np.random.default_rng(int(jax.random.randint(key, (), 1, 2**31 - 1))),
        )

    return solve
