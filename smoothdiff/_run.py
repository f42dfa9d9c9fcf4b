"""One run of a solver on the host: compiled steps, their history, and what is returned or kept."""

import dataclasses
import math
import operator
import os
import time
import warnings
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, PyTree

from smoothdiff._checkpoint import Checkpoint
from smoothdiff._identity import listed
from smoothdiff._limits import Limits
from smoothdiff._parameter_errors import Answer
from smoothdiff._problem import Problem, Trial
from smoothdiff._reraise import reraise
from smoothdiff._result import MinimiseError, Record, Result
from smoothdiff._solvers import Progress
from smoothdiff._solvers._random_numbers import takes_key
from smoothdiff._solvers._wrapped import Wrapped
from smoothdiff._unit_space import UnitSpace

# what a checkpoint has before there was a trial
_NO_TRIAL = Trial(np.empty(0), False)
# the numbers of a judgement
_NUMBERS = "fun", "smoothed", "stderr", "evaluations"
# the share of the time that saving may take
_SAVING = 0.05
_NONFINITE = "an estimate was NaN or infinite; `result` has what was found before. "
_ADVICE = {
    "propagate": 'If fun fails for some samples, give the solver nonfinite="drop", which leaves '
    "them out unless they are too many; if the iterates run away, take smaller steps or set bounds",
    "drop": 'Too few samples were finite for nonfinite="drop" to go on with the others: begin '
    "where fun is finite, take a smaller sigma, or set bounds within which it is",
}
_OVERFLOW = (
    ". Half the sum of squares of the residuals was too large for {}: scale them, or use float64"
)
_UNBOUNDED = (
    "\nNothing bounds the search: bounds=(low, high), or a space, keeps it to points where fun can "
    "be evaluated"
)


class _Judgement(NamedTuple):
    """What ended a run, so that the same call need not pay for it again; none without numbers."""

    y: PyTree
    numbers: np.ndarray


@dataclasses.dataclass
class Run:
    """Where a run stands: at every moment something that can be returned or saved."""

    problem: Problem
    y: PyTree
    state: Any
    units: UnitSpace
    keep_iterates: bool = True
    history: list[Record] = dataclasses.field(default_factory=list)
    start: float = dataclasses.field(default_factory=time.monotonic)
    file: Checkpoint | None = None
    save_due: float = 0.0
    stopped: Bool[Array, ""] | None = None
    trial: Trial | None = None
    judgement: _Judgement | None = None

    @property
    def steps(self) -> int:
        return int(self.state.progress.step)

    def reached(self, limits: Limits) -> str | None:
        """Why the limits end the run here, if they do.

        Where the function has no noise, which an evaluation tells, less is set aside to judge.
        """
        progress = self.state.progress
        seconds, lowest = time.monotonic() - self.start, progress.lowest_fun.item()
        count = progress.evaluations.item()
        reason = limits.reached(self.steps, count, seconds, lowest)
        if reason != "max_evaluations":
            return reason
        with self.problem.place():
            fewer = count - self.problem.spare(self.y, self.state)
        later = limits.reached(self.steps, fewer, seconds, lowest)
        if later is None and self.trial is None:
            with reraise(), self.problem.place():
                self.trial = jax.block_until_ready(self.problem.trial(self.y, self.state))
        return reason if self.trial is None or self.trial.noisy else later

    def attach(self, path: str | os.PathLike) -> None:
        """Keeps the run in a file from now on, and takes up the one that is already there."""
        problem = self.problem
        shapes = tuple(f"{leaf.dtype}{leaf.shape}" for leaf in jax.tree.leaves(self.state))
        file = Checkpoint(
            path,
            fun=problem.fun,
            y0=self.y,
            args=problem.args,
            solver=(problem.solver, shapes),
            keep_iterates=self.keep_iterates,
            **({"bounds": None} | problem.options),
        )
        iterate = self.units.natural(self.y) if self.keep_iterates else None
        record = Record(0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, iterate)
        saved = file.load((self.y, self.state, record, _NO_TRIAL, self._no_judgement()))
        if saved is not None:
            with problem.place():
                self.y, self.state = jax.tree.map(jnp.asarray, saved[:2])
            self.history, trial = _unstack(saved[2]), saved[3]
            self.trial = Trial(trial.fun, bool(trial.noisy)) if trial.fun.size else None
            self.judgement = saved[4] if saved[4].numbers.size else None
            self.start -= self.history[-1].seconds
            self._check_function(file)
            problem.resumed(self.state)
        self.file = file

    def _check_function(self, file: Checkpoint) -> None:
        """Raises ValueError if the function is no longer what it was at the lowest point.

        This takes an evaluation; if the value is another one, two more. If these differ again, the
        function has noise, and nothing is known. Nor is it of one that takes random numbers.
        """
        if takes_key(self.problem.options):
            return
        there, before = self.state.progress.lowest_y, self.state.progress.lowest_fun.item()
        now = self._fun(there)
        seen = now, before, *(value for r in self.history for value in (r.fun, r.smoothed))
        scale = max((abs(value) for value in seen if math.isfinite(value)), default=0.0)
        near = math.sqrt(jnp.finfo(self.state.progress.lowest_fun.dtype).eps) * scale
        if abs(now - before) <= near:
            return
        if math.isfinite(now - before) and all(self._fun(there) == now for _ in range(2)):
            raise file.other(f"fun at its lowest point is {now:.6g}, and was {before:.6g}")
        if file.doubtful:
            raise file.other(f"its {listed(file.doubtful)} differed")

    def _fun(self, y: PyTree) -> float:
        """The function, or half the sum of squares of residuals."""
        with reraise():
            leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(self.problem.value(y))]
        if self._is_of_residuals():
            return float(sum(np.sum(leaf * leaf) for leaf in leaves)) / 2
        return float(leaves[0])

    def save(self) -> None:
        """Writes the file, if there is one; what was computed is never lost for a full disk."""
        if self.file is None or self.steps == 0:
            return
        before = time.monotonic()
        history = jax.tree.map(lambda *leaves: np.stack(leaves), *self.history[: self.steps])
        try:
            ended = self.trial or _NO_TRIAL, self.judgement or self._no_judgement()
            self.file.save((self.y, self.state, history, *ended))
        except Exception as error:
            text = f"the checkpoint was not saved, the run goes on: {type(error).__name__}: {error}"
            warnings.warn(text, RuntimeWarning, stacklevel=2)
        after = time.monotonic()
        self.save_due = after + (after - before) / _SAVING

    def done(self) -> str | None:
        """Why the solver wants to stop, if it does."""
        if self.stopped is None:
            with self.problem.place():
                self.stopped = self.problem.done(self.y, self.state)
        return self.problem.reason(self.state) if self.stopped else None

    def step(self) -> Record:
        """Takes a step and keeps it, unless it failed."""
        with self.problem.place():
            return self._step()

    def _step(self) -> Record:
        with reraise():
            y, state, stopped = jax.block_until_ready(self.problem.step(self.y, self.state))
        progress = state.progress
        if not progress.finite:
            raise self._nonfinite(progress, bool(progress.overflowed))
        record = Record(
            step=progress.step.item(),
            evaluations=progress.evaluations.item(),
            seconds=time.monotonic() - self.start,
            fun=progress.lowest_fun.item(),
            smoothed=progress.smoothed.item(),
            stderr=progress.stderr.item(),
            sigma=progress.sigma.item(),
            y=jax.device_get(self.units.natural(y)),
            best=jax.device_get(self.units.natural(progress.lowest_y)),
        )
        # Ctrl-C may come between any two lines: the state has the last word on what was done
        kept = record.y if self.keep_iterates else None
        self.history.append(record._replace(y=kept, best=None))
        self.y, self.state, self.stopped, self.judgement = y, state, stopped, None
        if self.trial is not None and self.trial.noisy:
            self.trial = None  # of a run that had ended: another point may be lowest now
        if time.monotonic() >= self.save_due:
            self.save()
        return record

    def judged(self, reason: str, target: float | None = None) -> Result:
        """The result of a run that ended well, for this reason or with the target."""
        if self.judgement is None:
            with reraise(), self.problem.place():
                judged = self.problem.judge(self.y, self.state, self.trial)
                y, stats = jax.block_until_ready(judged)
            # a last batch that fails costs no more than the smoothed value
            if not np.isfinite(stats["fun"]):
                raise self._nonfinite()
            self.judgement = _Judgement(y, np.array([stats[name].item() for name in _NUMBERS]))
        y, values = self.judgement
        numbers = dict(zip(_NUMBERS, values.tolist(), strict=True))
        numbers["evaluations"] = int(numbers["evaluations"])
        # the judgement may be what finds it
        reached = target is not None and numbers["fun"] <= target
        return self._result(y, "target" if reached else reason, **numbers)

    def _no_judgement(self) -> _Judgement:
        return _Judgement(self.y, np.empty(0))

    def _ours(self) -> Any:
        """The solver, or the one of ours within another."""
        solver = self.problem.solver
        return solver.ours() if isinstance(solver, Wrapped) else solver

    def _is_of_residuals(self) -> bool:
        return isinstance(self._ours(), optx.AbstractLeastSquaresSolver)

    def _nonfinite(self, progress: Progress | None = None, overflowed=False) -> MinimiseError:
        advice = _ADVICE[getattr(self._ours(), "nonfinite", "propagate")]
        if callable(sigma := getattr(self._ours(), "sigma", None)):
            width = sigma(self.steps)
            if not all(np.all(np.asarray(leaf) > 0) for leaf in jax.tree.leaves(width)):
                advice = f"sigma of step {self.steps} is {width}: it must stay above zero"
        lowest = (progress or self.state.progress).lowest_fun
        if getattr(self._ours(), "log", False) and lowest < 0:
            advice = (
                "log=True is for functions that are never negative, and fun is negative somewhere: "
                "leave it out"
            )
        dtype = self.state.progress.lowest_fun.dtype
        if overflowed and self._is_of_residuals() and jnp.finfo(dtype).bits < 64:
            advice += _OVERFLOW.format(dtype)
        return MinimiseError(_NONFINITE + advice, self.found("nonfinite", progress))

    def failed(self, error: BaseException) -> MinimiseError:
        """What to raise where a black box failed, as it may at points that nothing keeps out."""
        anywhere = self.problem.options.get("bounds") is None
        advice = _UNBOUNDED if anywhere and getattr(error, "at_point", False) else ""
        return MinimiseError(str(error) + advice, self.found("failed"))

    def found(self, reason: str, progress: Progress | None = None) -> Result:
        """The result of a run that was cut short: no evaluation is made for it."""
        p = progress or self.state.progress
        fun, unknown = p.lowest_fun.item(), float("nan")
        evaluations = p.evaluations.item() + self.problem.uncounted(p)
        numbers = {"fun": fun, "smoothed": unknown, "stderr": unknown, "evaluations": evaluations}
        return self._result(p.lowest_y, reason, **numbers)

    def _result(self, y: PyTree, reason: str, **numbers: Any) -> Result:
        solver, state = self.problem.solver, self.state
        if isinstance(solver, Wrapped):
            # those that the user knows
            solver, state = solver.solver, state.state
        history = self.history[: self.steps]
        with self.problem.place():
            y, state = jax.tree.map(_of_jax, (y, state))
            natural = self.units.natural(y)
        return Result(
            natural,
            reason=reason,
            history=history,
            solver=solver,
            state=state,
            answer=Answer(y, self.units, self.problem.options.get("bounds")),
            **numbers,
        )


def _of_jax(leaf: Any) -> Any:
    """An array of NumPy's as one of JAX's."""
    return jnp.asarray(leaf) if isinstance(leaf, np.ndarray | np.generic) else leaf


def _unstack(records: Record) -> list[Record]:
    rows = zip(*(np.asarray(column).tolist() for column in records[:-2]), strict=True)
    at = lambda i: jax.tree.map(operator.itemgetter((i, ...)), records.y)
    return [Record._make((*row, at(i), None)) for i, row in enumerate(rows)]
