"""What a run gives: a record of each step, a result, and an error that keeps what was found."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
import optimistix as optx
from jaxtyping import Array, PyTree

_RESULTS = {
    "converged": optx.RESULTS.successful,
    "target": optx.RESULTS.successful,
    "stalled": optx.RESULTS.stagnation,
    "noise": optx.RESULTS.stagnation,
    "nonfinite": optx.RESULTS.nonfinite,
    "failed": optx.RESULTS.breakdown,
}


class Record(NamedTuple):
    """One step of `minimise`, in Python numbers and NumPy arrays.

    Attributes:
        step: which step, from 1.
        evaluations: evaluations of the function so far.
        seconds: time since the start, compilation included; a resumed run counts on.
        fun: the lowest value of the function so far, of all points that were evaluated, at the
            iterate or not; of least squares half the sum of squares. With noise it owes much to
            luck.
        smoothed: the smoothed function where the step started, as its batch estimated it; NaN of a
            solver that goes point by point.
        stderr: the standard error of `smoothed`; NaN where the batch cannot tell.
        sigma: the smoothing width of the step, the widest if there are several.
        y: the iterate after the step; None in a history without iterates.
    """

    step: int
    evaluations: int
    seconds: float
    fun: float
    smoothed: float
    stderr: float
    sigma: float
    y: PyTree[np.ndarray]


@dataclasses.dataclass(frozen=True)
class Result:
    """What `minimise` found.

    Attributes:
        y: the best point. Of a function without noise, always the lowest that was evaluated. With
            noise, found by evaluating that point again, the winner of fresh evaluations of a few
            candidates, the start among them. If the run was cut short ("interrupted", or an error)
            the lowest that was evaluated, which with noise may be luck.
        fun: the function there; of least squares half the sum of squares. With noise, the mean of
            three fresh evaluations.
        smoothed: the smoothed function there, from a last batch; a point of that batch which is
            lower still has become `y`. NaN if the run was cut short, or if a sample was not finite.
        stderr: the standard error of `smoothed`.
        evaluations: evaluations of the function, the judgement included; not those of a step that
            was broken off.
        reason: why the run stopped: "target", "max_steps", "max_evaluations", "max_seconds",
            "callback", "interrupted", or what the solver says: "converged", "stalled" after too
            many evaluations without a lower point, "noise" where nothing but noise is left; in an
            error "nonfinite" or "failed".
        history: one `Record` for each step, with the iterates if `keep_iterates` says so.
        solver: the solver, also where none was given.
        state: its last state.
    """

    y: PyTree[Array]
    fun: float
    smoothed: float
    stderr: float
    evaluations: int
    reason: str
    history: list[Record] = dataclasses.field(repr=False)
    solver: Any = dataclasses.field(repr=False)
    state: Any = dataclasses.field(repr=False)

    @property
    def value(self) -> PyTree[Array]:
        """The best point, by optimistix's name for it."""
        return self.y

    @property
    def result(self) -> optx.RESULTS:
        """The reason as optimistix has it: `successful` if it converged or reached the target."""
        return _RESULTS.get(self.reason, optx.RESULTS.nonlinear_max_steps_reached)

    @property
    def stats(self) -> dict[str, Any]:
        """The numbers of this result, as optimistix has them for a solver."""
        names = "fun", "smoothed", "stderr", "evaluations"
        return {name: getattr(self, name) for name in names}


class MinimiseError(RuntimeError):
    """A run failed: `result` is what it had found, `__cause__` what a black box raised."""

    def __init__(self, message: str, result: Result):
        super().__init__(message)
        self.result = result
