"""A solver of smoothdiff, run in compiled stretches of many steps: for runs of thousands of steps.

The iterates are those of `sd.minimise`; its loop on the host would take most of the time.
"""

from collections.abc import Callable
from typing import Any

import jax

from benchmarks._task import Solve, Task, Y

STRETCH = 20  # one stretch is this share of the steps so far


class Steps:
    """The steps of a solver on a task, as pure functions of its state."""

    def __init__(self, solver: Any, task: Task):
        self.number = task.budget.evaluations // solver.evaluations_per_step(task.reference)
        self._solver, self._task = solver, task

    def init(self, y: Y, key: jax.Array) -> Any:
        """The state before the first step."""
        value = jax.eval_shape(self._task.loss, y)
        options = self._options(key)
        return self._solver.init(self._fun, y, None, options, value, None, frozenset())

    def step(self, y: Y, state: Any, key: jax.Array) -> tuple[Y, Any]:
        """The next parameters and state. The key is the same for all steps of a run."""
        options = self._options(key)
        return self._solver.step(self._fun, y, None, options, state, frozenset())[:2]

    def _fun(self, y: Y, args: None) -> tuple[jax.Array, None]:
        return self._task.loss(y), None

    def _options(self, key: jax.Array) -> dict[str, Any]:
        return {"key": key, "bounds": self._task.bounds}


def in_stretches(build: Callable[[Task], Any], task: Task) -> Solve:
    """The solver that `build` gives for a task, recorded after each stretch of steps."""
    steps = Steps(build(task), task)
    init = jax.jit(steps.init)

    @jax.jit
    def advance(y, state, key, number):
        step = lambda _, carry: steps.step(carry[0], carry[1], key)
        return jax.lax.fori_loop(0, number, step, (y, state))

    def solve(y0, key, record):
        y, state, done = y0, init(y0, key), 0
        while done < steps.number:
            stretch = min(1 + done // STRETCH, steps.number - done)
            y, state = advance(y, state, key, stretch)
            done += stretch
            record(y)

    return solve
