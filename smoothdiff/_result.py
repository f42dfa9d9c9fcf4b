"""What a run gives: a record of each step, a result, and an error that keeps what was found."""

import dataclasses
import functools
from typing import Any, NamedTuple

import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, PyTree

from smoothdiff._parameter_errors import Answer, ParameterErrors
from smoothdiff._solvers._history import History
from smoothdiff._solvers._point_by_point import PointState

_RESULTS = {
    "converged": optx.RESULTS.successful,
    "target": optx.RESULTS.successful,
    "stalled": optx.RESULTS.stagnation,
    "noise": optx.RESULTS.stagnation,
    "nonfinite": optx.RESULTS.nonfinite,
    "failed": optx.RESULTS.breakdown,
}
NO_COVARIANCE = (
    "only results of sd.least_squares with GaussNewton and fewer than 100 parameters have a "
    "covariance"
)


class Record(NamedTuple):
    """One step of `minimise`, in Python numbers and NumPy arrays.

    Attributes:
        step: which step, from 1.
        evaluations: evaluations of the function so far.
        seconds: time since the start, compilation included; a resumed run counts on.
        fun: the lowest value so far, of all points that were evaluated; of least squares half the
            sum of squares. With noise it owes much to luck.
        smoothed: the smoothed function where the step started, as its batch estimated it; NaN if
            the solver goes point by point.
        stderr: the standard error of `smoothed`; NaN where the batch cannot tell.
        sigma: the smoothing width of the step, the widest if there are several.
        y: the iterate after the step; None in a history without iterates.
        best: the point at which the function was `fun`. A run that is stopped returns it. For
            callbacks; None in a history.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> bowl = lambda y, args: jnp.sum((y - 1) ** 2)
        >>> result = sd.minimise(bowl, jnp.zeros(2), key=jax.random.key(0), max_evaluations=30)
        >>> first = result.history[0]
        >>> first.step, first.fun >= result.fun
        (1, True)

    Source: own.
    """

    step: int
    evaluations: int
    seconds: float
    fun: float
    smoothed: float
    stderr: float
    sigma: float
    y: PyTree[np.ndarray]
    best: PyTree[np.ndarray] = None


@dataclasses.dataclass(frozen=True)
class Result:
    """What `minimise` found.

    Attributes:
        y: the best point. Without noise it is the lowest that was evaluated. Noise shows when that
            point is evaluated again; then a few candidates, the start among them, are evaluated
            afresh, and the lowest wins. For `takes_key=True` see `minimise`. If the run was cut
            short ("interrupted", or an error), it is the lowest that was evaluated, which with
            noise may be luck.
        fun: the function there; of least squares half the sum of squares. With noise, the mean of
            three fresh evaluations.
        smoothed: the smoothed function there, from a last batch. If a point of that batch is lower
            still, it becomes `y`. NaN if the run was cut short, or if a sample was not finite.
        stderr: the standard error of `smoothed`. NaN where that is of a model and no batch: with
            `NewtonCG` and `GaussNewton` and fewer than 100 parameters, with a key or without. The
            errors of parameters are `parameter_errors`.
        evaluations: evaluations of the function, the judgement included; not those of a step that
            was broken off.
        reason: why the run stopped. A limit: "target", also where the last judgement found it,
            "max_steps", "max_evaluations", "max_seconds", "callback", "interrupted". Or the solver:
            "converged"; "stalled", after too many evaluations that hardly lowered it; "noise",
            where nothing but noise is left. In an error: "nonfinite" or "failed".
        history: one `Record` for each step, with the iterates if `keep_iterates` says so.
        solver: the solver, also where none was given.
        state: its last state.
        answer: `y` as the solver sees it, in unit coordinates and within bounds.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> bowl = lambda y, args: jnp.sum((y - 1) ** 2)
        >>> result = sd.minimise(bowl, jnp.zeros(2), key=jax.random.key(0), target=1e-6)
        >>> print(result.y.round(2), result.reason)
        [1. 1.] target

    Source: own.
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
    answer: Answer | None = dataclasses.field(default=None, repr=False)

    @property
    def covariance(self) -> Float[Array, "n n"] | None:
        r"""The covariance of the parameters of least squares, which are taken as one vector.

        $$ C = s^2 (J^T J)^{-1}, \qquad s^2 = \sum_p r_p^2 / (P - n) $$

        It holds at a minimum, for P residuals whose errors are independent and of the same size. J
        is fitted to those evaluations of the run that are near `y`; no more are made for it. With a
        space, C is computed in unit coordinates and multiplied by the slopes of natural values.

        NaN for a parameter at a bound; the errors of the others hold for it fixed there. NaN also
        for a parameter of which the evaluations do not tell enough: a warning names it, and
        `with_covariance` evaluates more. Call that as well for a function that jumps, as near
        evaluations may show one jump alone, and for one that takes a key, as evaluations with
        several keys tell no slopes. None unless the solver is `GaussNewton` with fewer than 100
        parameters.
        """
        return None if self._errors is None else self._errors.covariance

    @property
    def parameter_errors(self) -> PyTree:
        """The standard errors of the parameters, a pytree like `y`: the roots of the variances.

        None where there is no covariance. `stderr` is that of the smoothed function.
        """
        return None if self._errors is None else self._errors.standard

    def parameter_intervals(self, level: float = 0.95) -> tuple[PyTree, PyTree]:
        """The ends (low, high) of intervals that hold a parameter with this probability.

        By Student's t with P - n degrees of freedom, and symmetric in unit coordinates: with a
        logarithmic scale they are factors, and stay positive.

        Raises:
            ValueError: a level that is no probability; a result without a covariance.
        """
        if not 0 < level < 1:
            raise ValueError(f"level={level} must be between 0 and 1, such as 0.95")
        if self._errors is None:
            raise ValueError(NO_COVARIANCE)
        return self._errors.intervals(level)

    @functools.cached_property
    def _errors(self) -> ParameterErrors | None:
        """Computed when it is asked for."""
        history = kept_residuals(self)
        if self.answer is None or history is None:
            return None
        takes_key = self.state.search.average is not None
        return ParameterErrors.of(self.y, self.answer, history, self.fun, takes_key)

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


def kept_residuals(result: Result) -> History | None:
    """The evaluations that the run has kept, if they are of residuals, point by point."""
    state = result.state
    if not (isinstance(state, PointState) and result.solver.squares):
        return None
    history = state.around_lowest()
    history = dataclasses.replace(history, valid=history.evaluated())
    if state.search.average is not None:
        # those with several keys differ by more than slopes do
        history = dataclasses.replace(history, valid=history.valid & False)
    return history


class MinimiseError(RuntimeError):
    """A run failed: `result` is what it had found, `__cause__` what a black box raised.

    Args:
        message: what failed, and what to do.
        result: the `Result` until then.

    Example:
        >>> import jax, numpy as np, smoothdiff as sd
        >>> def fails(y):
        ...     if y > 0.5:
        ...         raise ArithmeticError("no convergence")
        ...     return np.square(y - 1)
        >>> box = sd.black_box(fails, 0.0)
        >>> try:
        ...     sd.minimise(lambda y, args: box(y), 0.0, key=jax.random.key(0))
        ... except sd.MinimiseError as error:
        ...     print(error.result.reason, error.result.evaluations > 0)
        failed True

    Source: own.
    """

    def __init__(self, message: str, result: Result):
        super().__init__(message)
        self.result = result
