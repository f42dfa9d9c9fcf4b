"""The baselines that have a name."""

from collections.abc import Callable

from smoothdiff._ad_slope import ADSlope
from smoothdiff._baselines import AbstractBaseline, Center, Mean, NoBaseline
from smoothdiff._gp import GaussianProcess
from smoothdiff._least_squares import LeastSquares
from smoothdiff._noise import NoiseSampler

# Beyond, the regression's N^3 operations are worth more samples than the error that they save
_MOST_SAMPLES = 1024


class Auto(AbstractBaseline):
    """The default, "auto": "gp" where it is known to gain, else "mean".

    That is with at least as many samples as parameters (fewer leave nothing to interpolate) and at
    most 1,024 samples (beyond, N^3 operations are worth more samples), for Gaussian smoothing of
    an objective without a support.
    """

    def __call__(self, values, draws, log_ratio, valid, center):
        gaussian = not isinstance(draws.sampler, NoiseSampler)
        gains = gaussian and draws.n <= draws.num <= _MOST_SAMPLES
        return (GaussianProcess() if gains else Mean())(values, draws, log_ratio, valid, center)


NAMED: dict[str, Callable[[], AbstractBaseline]] = {
    "auto": Auto,
    "none": NoBaseline,
    "mean": Mean,
    "center": Center,
    "linear": lambda: LeastSquares(1),
    "quadratic": lambda: LeastSquares(2),
    "gp": GaussianProcess,
    "ad": ADSlope,
}


def as_baseline(baseline: str | AbstractBaseline) -> AbstractBaseline:
    """The baseline that a name stands for."""
    if isinstance(baseline, AbstractBaseline):
        return baseline
    if isinstance(baseline, str) and baseline in NAMED:
        return NAMED[baseline]()
    raise ValueError(f"baseline must be one of {sorted(NAMED)} or an object, not {baseline!r}")
