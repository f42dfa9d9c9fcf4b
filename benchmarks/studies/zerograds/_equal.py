"""Runs at equal schedules: one compiled program for all rates and schedules of a method on a task.

All methods drive the same Adam. A schedule says which shares of sigma and of the rate are left when
the budget is spent, both falling linearly; the rate at the start is what is tuned.
"""

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from benchmarks._cache import cached, fingerprint
from benchmarks._task import Problem, Task
from benchmarks._tuning import Best, Rates, Settings, geometric_mean, seeds, walk
from benchmarks.studies.zerograds._runs import FLOOR, about


class Schedule(NamedTuple):
    """Shares that are left at the end."""

    sigma: float
    rate: float


SCHEDULES = {"constant": Schedule(1.0, 1.0), "annealed": Schedule(0.1, 0.02)}
RATES = Rates(0.15, 3.0)  # in units of sigma
TOGETHER = 2  # starts that one call of the program is for
TUNED_ON = 2  # starts

Make = Callable[[Problem, optax.Schedule, optax.GradientTransformation], Any]


class Program:
    """A method on a task: errors from some starts, for any rate and schedule.

    Args:
        task: The task.
        name: Of the method, in names of files.
        make: (problem, sigma, optimiser) -> solver, both schedules being functions of the step.
        folder: Keeps what has been run.
        fresh: Run it again.
    """

    def __init__(self, task: Task, name: str, make: Make, folder: Path, fresh: bool = False):
        self._task, self._folder = task, folder / "equal" / task.name
        self._name, self._fresh, self._points = name, fresh, about(task)["evaluations"]
        losses = [float(task.exact_loss(y)) for y in (task.start(0), task.score.reference)]
        together = jax.jit(jax.vmap(partial(_errors, task, make, self._points), (0, 0, None)))
        self._lowered = together.lower(*self._given([0], 1.0, Schedule(1.0, 1.0)))
        self._source = fingerprint(self._lowered.as_text(), losses)

    @cached_property
    def _compiled(self) -> Callable[..., jax.Array]:
        return self._lowered.compile()

    def _given(self, starts: list[int], rate: float, schedule: Schedule) -> tuple[Any, ...]:
        """What the program takes, which has one shape."""
        padded = starts + starts[-1:] * (TOGETHER - len(starts))
        ys = jnp.stack([self._task.start(seed) for seed in padded])
        keys = jnp.stack([jax.random.key(seed) for seed in padded])
        return ys, keys, tuple(map(jnp.asarray, (rate, *schedule)))

    def tuned(self, schedule: str) -> Best:
        """The best rate of a schedule, on starts that are not scored, by the error at the end."""

        def cost(settings: Settings) -> float:
            errors = self(schedule, settings["rate"], seeds(TUNED_ON))
            return geometric_mean(errors[:, -1].tolist(), FLOOR)

        return walk(cost, {"rate": RATES}, {"rate": RATES.first})

    def __call__(self, schedule: str, rate: float, starts: Sequence[int]) -> np.ndarray:
        """The error at each of the task's points, relative to the start, a row for each start."""
        rows = []
        for first in range(0, len(starts), TOGETHER):
            some = list(starts[first : first + TOGETHER])
            path = self._folder / f"{self._name}-{schedule}-{rate:g}-{some[0]}-{len(some)}.npz"
            make = partial(self._run, schedule, rate, some)
            rows.append(cached(path, self._source, make, self._fresh)["errors"])
        return np.concatenate(rows)

    def _run(self, schedule: str, rate: float, starts: list[int]) -> dict[str, np.ndarray]:
        found = self._compiled(*self._given(starts, rate, SCHEDULES[schedule]))
        return {"errors": np.asarray(found, float)[: len(starts)]}


def _errors(
    task: Task, make: Make, points: Sequence[int], y: Any, key: jax.Array, how: Any
) -> jax.Array:
    """The error of the iterate after so many evaluations, from one start."""
    problem, (rate, sigma_left, rate_left) = task.problem, how
    steps = lambda solver: problem.budget.evaluations // solver.evaluations_per_step(y)
    number = steps(make(problem, optax.constant_schedule(problem.sigma), optax.sgd(1.0)))
    falling = lambda first, left: optax.linear_schedule(first, left * first, number)
    optim = optax.adam(falling(rate * problem.sigma, rate_left))
    solver = make(problem, falling(problem.sigma, sigma_left), optim)
    fun, options = lambda y, args: (problem.loss(y), None), {"key": key, "bounds": problem.bounds}
    value = jax.eval_shape(problem.loss, y)
    state = solver.init(fun, y, None, options, value, None, frozenset())

    def step(_: Any, carry: Any) -> Any:
        return solver.step(fun, carry[0], None, options, carry[1], frozenset())[:2]

    def until(carry: Any, ends: jax.Array) -> Any:
        carry = jax.lax.fori_loop(ends[0], ends[1], step, carry)
        return carry, task.exact_loss(carry[0])

    ends = np.asarray(points) // solver.evaluations_per_step(y)
    _, found = jax.lax.scan(until, (y, state), jnp.stack([np.append(0, ends[:-1]), ends], 1))
    return found / task.exact_loss(y)


class Differences(NamedTuple):
    """Adam on central differences, with what a program needs of a solver.

    Args:
        sigma: That of each step; a difference is over `SHARE` of it to each side.
        optim: What is driven by it.
    """

    sigma: optax.Schedule
    optim: optax.GradientTransformation

    SHARE = 0.3

    def evaluations_per_step(self, y: jax.Array) -> int:
        """Two for each parameter."""
        return 2 * y.size

    def init(self, fun, y, args, options, f_struct, aux_struct, tags) -> Any:
        """The optimiser's state and the number of the step."""
        return self.optim.init(y), jnp.zeros((), jnp.int32)

    def step(self, fun, y, args, options, state, tags) -> Any:
        """One gradient, one update, within the bounds."""
        opt_state, number = state
        width = self.SHARE * jnp.asarray(self.sigma(number), y.dtype)
        value = lambda i, shift: fun(y.at[i].add(shift), args)[0]
        slope = lambda i: (value(i, width) - value(i, -width)) / (2 * width)
        grad = jax.lax.map(slope, jnp.arange(y.size))
        updates, opt_state = self.optim.update(grad, opt_state, y)
        return jnp.clip(y + updates, *options["bounds"]), (opt_state, number + 1), None
