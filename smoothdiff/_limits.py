"""When a run ends, beside what its solver says: steps, evaluations, seconds, a target."""

import math
import operator
from typing import Any, NamedTuple

import jax
from jaxtyping import Array, PyTree

from smoothdiff._solvers import AbstractSmoothSolver

# without any limit: evaluations for each parameter, and one, of a solver that ends by itself, and
# steps of the others
_EVALUATIONS, _STEPS = 200, 256


class NoRoomError(ValueError):
    """A limit that leaves no room for a step."""


class Limits(NamedTuple):
    """The most steps, seconds, and evaluations after which there is still room for a step.

    The run also ends at a value of the function that is at most the `target`.
    """

    steps: int | None
    evaluations: int | None
    seconds: float | None
    target: float | None
    expected: int | None

    @staticmethod
    def of(
        solver: AbstractSmoothSolver,
        y: PyTree[Array],
        max_steps: Any,
        max_evaluations: Any,
        max_seconds: Any,
        target: Any,
    ) -> "Limits":
        """Checks the limits of a call.

        Raises:
            ValueError: a limit that is no number of the right kind, or leaves no room for a step.
        """
        steps = _count(max_steps, "max_steps")
        evaluations = _count(max_evaluations, "max_evaluations")
        seconds = _number(max_seconds, "max_seconds")
        if seconds is not None and seconds < 0:
            raise ValueError(f"max_seconds={max_seconds} must be 0 or more, or None for no limit")
        goal = _number(target, "target")
        step, final = solver.evaluations_per_step(y), solver.final_evaluations(y)
        if steps is None and evaluations is None:
            if solver.sizes(y) is None:
                return Limits(_STEPS, None, seconds, goal, _STEPS)
            n = sum(leaf.size for leaf in jax.tree.leaves(y))
            evaluations = _EVALUATIONS * (n + 1) + step + final
        if evaluations is None:
            return Limits(steps, None, seconds, goal, steps)
        room = evaluations - final - step
        if room < 0:
            fewer = ", or lower the solver's num_samples" if step > 1 else ""
            raise NoRoomError(
                f"max_evaluations={max_evaluations} leaves no room: a step takes {step}, judging "
                f"the result {final}. Allow {step + final}{fewer}"
            )
        fit = room // step + 1
        return Limits(steps, room, seconds, goal, fit if steps is None else min(fit, steps))

    def reached(self, steps: int, evaluations: int, seconds: float, lowest: float) -> str | None:
        """Why the run has to end here, if it has to."""
        if self.target is not None and lowest <= self.target:
            return "target"
        if self.steps is not None and steps >= self.steps:
            return "max_steps"
        if self.evaluations is not None and evaluations > self.evaluations:
            return "max_evaluations"
        if self.seconds is not None and seconds >= self.seconds:
            return "max_seconds"
        return None


def _count(value: Any, name: str) -> int | None:
    if value is None:
        return None
    try:
        count = operator.index(value)
    except TypeError:
        count = -1
    if count < 0:
        raise ValueError(
            f"{name}={value!r} must be a whole number, 0 or more, or None: int({name})"
        )
    return count


def _number(value: Any, name: str) -> float | None:
    if value is None:
        return None
    try:
        number = float(value)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name} must be a number, or None for no limit: {value!r}") from error
    if math.isnan(number):
        raise ValueError(f"{name} is NaN: give a number, or None for no limit")
    return number
