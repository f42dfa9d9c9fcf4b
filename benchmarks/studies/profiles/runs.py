"""A run of a method on a case: the exact values are kept where they are lower than before."""

import warnings
from collections.abc import Callable
from contextlib import redirect_stdout
from io import StringIO
from typing import Any, NamedTuple

import numpy as np

from benchmarks._task import NotAble
from benchmarks.studies.profiles.kinds import scale
from benchmarks.studies.profiles.problems import Case

SEED = 0
FAILED = "failed"  # so begins what is said of runs that ended by an error


class Spent(Exception):
    """The budget is."""


class Seen:
    """The function as a method sees it: disturbed, counted, and no more than the budget allows."""

    def __init__(self, case: Case, budget: int):
        self.case, self.budget = case, budget
        self.evaluations, self.values = [], []  # where it was lower than before
        self.count, self.lowest = 0, np.inf
        self.at_start = np.asarray(case.fun(case.start), float)
        self._scale, self._rng = scale(self.at_start), np.random.default_rng(SEED)

    def __call__(self, x: Any) -> Any:
        """An array of residuals, or a number."""
        if self.count >= self.budget:
            raise Spent
        self.count += 1
        exact = np.asarray(self.case.fun(np.asarray(x, float)), float)
        if (value := loss(exact)) < self.lowest:
            self.lowest = value
            self.evaluations.append(self.count)
            self.values.append(value)
        seen = self.case.kind.disturb(exact, self._scale, self._rng)
        return seen if seen.ndim else float(seen) if np.isfinite(seen) else np.inf


class Method(NamedTuple):
    """A method: whether it is for residuals or for numbers, and how it minimises what is seen."""

    title: str
    residuals: bool
    search: Callable[[Seen], Any]
    source: str  # a change of it makes earlier runs stale


def loss(exact: np.ndarray) -> float:
    """The sum of squared residuals, or the number itself; infinite if it is not finite."""
    value = float(exact @ exact) if exact.ndim else float(exact)
    return value if np.isfinite(value) else np.inf


def trace(method: Method, case: Case, budget: int) -> dict[str, Any]:
    """What the method found, after how many evaluations; how many it took, and what ended it."""
    ignoring = warnings.catch_warnings(action="ignore")
    with ignoring, np.errstate(all="ignore"), redirect_stdout(StringIO()):
        seen, ended = Seen(case, budget), "by itself"
        np.random.seed(SEED)  # noqa: NPY002, some methods draw from there
        try:
            method.search(seen)
        except Spent:
            ended = "by the budget"
        except NotAble:
            raise
        except Exception as error:  # of a method: what it had found stands
            ended = f"{FAILED}: {type(error).__name__}: {error}"
    return {
        "evaluations": np.array(seen.evaluations, int),
        "values": np.array(seen.values, float),
        "start": loss(seen.at_start),
        "count": seen.count,
        "ended": ended,
    }
