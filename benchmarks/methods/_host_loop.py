"""How methods that are solvers of smoothdiff run: by `sd.minimise` or its twin."""

import math
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from benchmarks._task import Problem, Solve, Y
from smoothdiff import Record


def run_by(
    minimise: Callable, problem: Problem, fun: Callable[..., Any], solver: Any, **options: Any
) -> Solve:
    """The solver on a function of y, and of a key if the options say so; compiled once."""

    def with_args(y, args, *key):
        return fun(y, *key)

    def solve(y0, key, record):
        best = _Best(y0)
        result = minimise(
            with_args,
            y0,
            key=key,
            solver=solver,
            max_evaluations=problem.budget.evaluations,
            bounds=problem.bounds,
            callback=lambda step: record(best.after(step)),
            **options,
        )
        if result.reason == "interrupted":
            raise KeyboardInterrupt
        record(result.y)

    return solve


class _Best:
    """What is shown of a run: of a solver that goes point by point, the best that was evaluated.

    That is what a user gets who stops it; its iterates look around, far away too, or begin again
    elsewhere. Solvers of batches show each iterate, until one is back at y0 after it had moved
    away: a search that follows another one is hidden until it has seen something better.
    """

    def __init__(self, y0: Y):
        self._y0, self._shown, self._lowest = jax.device_get(y0), y0, np.inf
        self._moved, self._target = False, np.inf

    def after(self, step: Record) -> Y:
        if math.isnan(step.smoothed):
            return step.best
        moved = not jax.tree.all(jax.tree.map(np.array_equal, step.y, self._y0))
        if self._moved and not moved:
            self._target = self._lowest
        self._moved = moved
        self._lowest = min(self._lowest, step.smoothed)
        if step.smoothed < self._target:
            self._target, self._shown = np.inf, step.y
        return self._shown
