"""Derivative-free searches of other libraries, one evaluation at a time; they know the bounds."""

import warnings

import numpy as np

from benchmarks._task import MethodEntry, Problem, Record, Solve
from benchmarks.methods._flat import Flat, package, seed_of

TOLERANCE = 1e-9  # of Nelder-Mead, in units of the problem's sigma
ENDLESS = 2**31  # record ends it


class OneByOne:
    """The loss for libraries on the host: a number for a vector, recorded after each evaluation.

    What it records is the best point so far, by what the evaluations said.
    """

    def __init__(self, flat: Flat, record: Record):
        self._flat, self._record = flat, record
        self._lowest, self._best = np.inf, None

    def __call__(self, x: np.ndarray) -> float:
        """Evaluates one point."""
        value = float(self._flat.value(np.asarray(x, self._flat.dtype)))
        if self._best is None or value < self._lowest:
            self._lowest, self._best = value, self._flat.tree(x)
        self._record(self._best)
        return value


def nelder_mead(problem: Problem, *, edge: float = 1.0) -> Solve:
    """The edges of the first simplex, in units of sigma, lead to where the bounds leave room."""
    from scipy import optimize

    flat = Flat(problem)
    first = edge * problem.sigma

    def solve(y0, key, record):
        start = flat.start(y0)
        room = np.where(start + first <= flat.box[1], 1, -1)
        options = {
            "initial_simplex": start + first * np.vstack([0 * start, np.diag(room)]),
            "adaptive": True,
            "xatol": TOLERANCE * problem.sigma,
            "fatol": np.inf,  # on a plateau all values are the same
            "maxiter": ENDLESS,
            "maxfev": ENDLESS,
        }
        loss = OneByOne(flat, record)
        optimize.minimize(loss, start, method="Nelder-Mead", bounds=flat.box.T, options=options)

    return solve


def annealing(problem: Problem) -> Solve:
    """With the defaults of SciPy's `dual_annealing`, but without its local search.

    That takes derivatives by differences, which are zero on plateaus.
    """
    from scipy import optimize

    flat = Flat(problem)

    def solve(y0, key, record):
        optimize.dual_annealing(
            OneByOne(flat, record),
            flat.box.T,
            x0=flat.start(y0),
            maxiter=ENDLESS,
            maxfun=ENDLESS,
            no_local_search=True,
            rng=np.random.default_rng(seed_of(key)),
        )

    return solve


def py_bobyqa(problem: Problem, *, first: float = 1.0) -> Solve:
    """A trust region on quadratic interpolation. Its licence is the GPL.

    The first radius is in units of sigma, if there is room; it restarts where its radius has
    shrunk, with NumPy's global random numbers, so that restarts are not tied to the key.
    """
    pybobyqa = package("pybobyqa", "Py-BOBYQA")
    flat = Flat(problem)
    low, high = flat.box
    radius = min(first * problem.sigma, 0.49 * float(np.min(high - low)))

    def solve(y0, key, record):
        with warnings.catch_warnings(action="ignore"):  # singular systems, on plateaus
            pybobyqa.solve(
                OneByOne(flat, record),
                flat.start(y0),
                bounds=(low, high),
                rhobeg=radius,
                rhoend=1e-8 * radius,
                maxfun=2 * problem.budget.evaluations,  # record ends it earlier
                user_params={"restarts.use_restarts": True},
                do_logging=False,
            )

    return solve


WIDTHS = (0.5, 1.0, 2.0)
METHODS = {
    "nelder_mead": MethodEntry("Nelder-Mead (SciPy)", ("scene",), nelder_mead, {"edge": WIDTHS}),
    "annealing": MethodEntry("Simulated annealing (SciPy)", ("scene", "program"), annealing),
    "py_bobyqa": MethodEntry("Py-BOBYQA", (), py_bobyqa, {"first": WIDTHS}),
}
