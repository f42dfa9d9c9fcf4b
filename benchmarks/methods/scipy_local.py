"""The derivative-free methods of SciPy, one evaluation at a time; they know the bounds."""

import numpy as np
from scipy import optimize

from benchmarks._task import Solve, Task
from benchmarks.methods._flat import Flat, OneByOne

TOLERANCE = 1e-9  # in units of the task's sigma


def nelder_mead(task: Task) -> Solve:
    """The first simplex has edges of sigma, into the room that the bounds leave."""
    flat = Flat(task)

    def solve(y0, key, record):
        start = flat.start(y0)
        room = np.where(start + task.sigma <= np.asarray(flat.high, float), 1, -1)
        options = {
            "initial_simplex": start + task.sigma * np.vstack([0 * start, np.diag(room)]),
            "adaptive": True,
            "xatol": TOLERANCE * task.sigma,
            "fatol": np.inf,  # on a plateau all values are the same
        }
        _minimise(flat, task, "Nelder-Mead", OneByOne(flat, record), start, options)

    return solve


def powell(task: Task) -> Solve:
    """Searches along lines from bound to bound."""
    flat = Flat(task)

    def solve(y0, key, record):
        options = {"ftol": TOLERANCE, "xtol": 1e-6, "direc": task.sigma * np.eye(flat.size)}
        _minimise(flat, task, "Powell", OneByOne(flat, record), flat.start(y0), options)

    return solve


def _minimise(flat: Flat, task: Task, method: str, loss: OneByOne, start, options: dict) -> None:
    limits = dict.fromkeys(("maxiter", "maxfev"), 2 * task.budget.evaluations)  # record ends it
    bounds = np.stack([flat.low, flat.high], axis=1).astype(float)
    optimize.minimize(loss, start, method=method, bounds=bounds, options=options | limits)


VARIANTS = {
    "nelder_mead": ("Nelder-Mead (SciPy)", nelder_mead),
    "powell": ("Powell (SciPy)", powell),
}
