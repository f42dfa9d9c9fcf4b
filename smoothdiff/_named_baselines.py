"""The baselines that have a name."""

from collections.abc import Callable

from smoothdiff._baselines import AbstractBaseline, Center, Mean, NoBaseline
from smoothdiff._gp import GaussianProcess
from smoothdiff._least_squares import LeastSquares

NAMED: dict[str, Callable[[], AbstractBaseline]] = {
    "none": NoBaseline,
    "mean": Mean,
    "center": Center,
    "linear": lambda: LeastSquares(1),
    "quadratic": lambda: LeastSquares(2),
    "gp": GaussianProcess,
}


def as_baseline(baseline: str | AbstractBaseline) -> AbstractBaseline:
    """The baseline that a name stands for."""
    if isinstance(baseline, AbstractBaseline):
        return baseline
    if baseline in NAMED:
        return NAMED[baseline]()
    raise ValueError(f"baseline must be one of {sorted(NAMED)} or an object, not {baseline!r}")
