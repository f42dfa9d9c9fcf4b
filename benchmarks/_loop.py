"""The run loop: each method from each start, counted, stopped, scored, and kept on disk.

A run is one method from one start. It is written as soon as it ends, so that an interrupted
benchmark goes on where it was.
"""

import dataclasses
import itertools
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.flatten_util import ravel_pytree
from tqdm import tqdm

from benchmarks._cache import cached, fingerprint
from benchmarks._machine import commit, here
from benchmarks._task import (
    Budget,
    Method,
    NativeAD,
    NotAble,
    Problem,
    Solve,
    Task,
    Y,
    precision_of,
)

CLOSED = 1e-8  # the smallest gap that is scored
GROWTH = 1.1  # a trace keeps a point when the evaluations have grown by this factor
WARM_UP_SEED = 1_000_003  # a start that is not in any ensemble
WARM_UP_SECONDS = 60  # it goes on that long, as solvers compile some of their parts late
WARM_UP_ITERATIONS = 3  # where there are gradients, and methods are one loop

Point = tuple[int, float, np.ndarray]  # evaluations, seconds, the parameters as a vector
# seed, ended, machine, commit, warm_up_seconds, evaluations, seconds, an array for each error
Run = dict[str, Any]
Runs = dict[Method, list[Run] | NotAble]


class Stop(Exception):
    """Raised by `record` to stop a method; says what ended the run."""


class Counter:
    """Counts on the host what is evaluated inside jit, vmap and scan.

    The first number of the value passes through a callback that gives it back as it is. So a call
    is counted if and only if its value is used, whatever the function is made of. Not the whole
    value: on one core JAX may hang where it is to hand more than 100 kB to a callback.
    """

    def __init__(self):
        self.evaluations = 0

    def watched(self, problem: Problem) -> Problem:
        """The problem as the methods see it: whatever evaluates it is counted."""
        seen: dict[str, Any] = {
            name: self.watch(fun)
            for name in ("loss", "residuals", "keyed", "terms")
            if (fun := getattr(problem, name)) is not None
        }
        if (grey := problem.grey) is not None:
            seen["grey"] = grey._replace(render=self.watch(grey.render))
            seen["loss"] = seen["grey"].loss
        if (native_ad := problem.native_ad) is not None:
            seen["native_ad"] = lambda: self._watch_native_ad(native_ad())
        return dataclasses.replace(problem, **seen)

    def watch(self, fun: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
        """The same function, counted: one for each y, whatever the size of the value."""

        def counted(*y_and_key: Any) -> jax.Array:
            value = fun(*y_and_key)
            flat = value.ravel()
            out = jax.ShapeDtypeStruct((), value.dtype)
            first = jax.pure_callback(self._let_pass, out, flat[0], vmap_method="expand_dims")
            return flat.at[0].set(first).reshape(value.shape)

        return counted

    def _watch_native_ad(self, native_ad: NativeAD) -> NativeAD:
        """The same; a gradient costs two: the picture and the pass back."""

        def counted(y: Y) -> tuple[Any, Y]:
            self.evaluations += 2
            return native_ad(y)

        return counted

    def _let_pass(self, first):
        first = np.asarray(first)
        self.evaluations += first.size
        return first


class Recorder:
    """Stamps each y with the evaluations and seconds so far, and ends the run in time.

    Of the points it keeps about 25 for each factor of ten in evaluations, and always the last. A
    run ends early where `gap(y)` is at the last level: nothing would be scored after it.
    """

    def __init__(
        self,
        counter: Counter,
        y0: Y,
        budget: Budget,
        iterations: float = np.inf,
        gap: Callable[[Y], float] | None = None,
    ):
        self._counter, self._budget, self._iterations = counter, budget, iterations
        self._gap = gap
        self.trace = [(0, 0.0, flat(y0))]
        self.last = self.trace[0]
        counter.evaluations = 0
        self._began = time.process_time()

    def __call__(self, y: Y, iterations: int | None = None) -> None:
        """Takes the y of an iteration; raises Stop after the last one."""
        found = flat(y)  # waits for the evaluations behind y
        seconds = time.process_time() - self._began
        evaluations = self._counter.evaluations if iterations is None else iterations
        self.last = (evaluations, seconds, found)
        if iterations is not None or evaluations >= GROWTH * self.trace[-1][0]:
            self.trace.append(self.last)
        self._iterations -= 1
        spent = evaluations >= self._budget.evaluations or seconds >= self._budget.seconds
        if spent or self._iterations <= 0:
            raise Stop("by the budget")
        if self._gap is not None:
            solved = self._gap(y) <= CLOSED
            self._began += time.process_time() - self._began - seconds  # that was not the method's
            if solved:
                raise Stop("at the optimum")

    def finish(self) -> list[Point]:
        """The points kept, with the last one."""
        if self.trace[-1] is not self.last:
            self.trace.append(self.last)
        return self.trace


class Runner:
    """Runs methods on a task: prepared once, counted, stopped, and scored.

    Args:
        task: The task.
        keep: What a run had found after at most so many evaluations is kept too, beside the last.
    """

    def __init__(self, task: Task, keep: Collection[int]):
        self._task, self._keep, self._counter = task, keep, Counter()
        self._problem = self._counter.watched(task.problem)
        self._exact_loss = jax.jit(lambda y: task.exact_loss(y))  # there may be none
        self._prepared: dict[Method, tuple[Solve, float]] = {}

    def __call__(self, method: Method, seed: int) -> Run:
        """One run with its scores."""
        if method not in self._prepared:
            began = time.perf_counter()
            solve = method.prepare(self._problem)
            # it compiles on a start of its own, which is not charged to it
            self._warm_up(solve)
            self._prepared[method] = solve, time.perf_counter() - began
        solve, warm_up = self._prepared[method]
        lowest = self._task.score.optimum
        above = None if lowest is None else lambda y: float(self._exact_loss(y)) - lowest
        trace, ended = self._record(solve, seed, gap=above)
        unravel = ravel_pytree(self._task.problem.like)[1]
        evaluations, seconds, ys = zip(*trace, strict=True)
        errors = self._errors if self._task.score.errors is None else self._own_errors
        return {
            "warm_up_seconds": warm_up,
            "seed": seed,
            "ended": ended,
            "machine": here(),
            "commit": commit(),
            "evaluations": np.array(evaluations),
            "seconds": np.array(seconds),
            **errors([unravel(y) for y in ys], seed),
            "found": ys[-1],
            **{f"found {n}": ys[within(evaluations, n)] for n in self._keep},
        }

    def _warm_up(self, solve: Solve) -> None:
        """Runs what a run compiles: all of one, unless that takes longer than any may."""
        if self._problem.gradient is not None:
            self._record(solve, WARM_UP_SEED, iterations=WARM_UP_ITERATIONS)
        else:
            budget = self._problem.budget._replace(seconds=WARM_UP_SECONDS)
            self._record(solve, WARM_UP_SEED, budget=budget)

    def _record(
        self, solve: Solve, seed: int, budget: Budget | None = None, **until: Any
    ) -> tuple[list[Point], str]:
        """The trace of a run, and why it ended."""
        if self._task.choose is not None:
            self._task.choose(seed)
        y0 = self._task.start(seed)
        recorder = Recorder(self._counter, y0, budget or self._problem.budget, **until)
        try:
            solve(y0, jax.random.key(seed), recorder)
        except Stop as stop:
            return recorder.finish(), str(stop)
        return recorder.finish(), "by the method"

    def _errors(self, points: list[Y], seed: int) -> dict[str, Any]:
        """Errors relative to those of the start, except for the gap."""
        score, choose = self._task.score, self._task.choose
        gap = np.array([float(self._exact_loss(y)) for y in points]) - (score.optimum or 0.0)
        sought = score.reference if choose is None else choose(seed)
        length = lambda y: np.linalg.norm(flat(y).astype(float) - flat(sought))
        away = length if score.distance is None else jax.jit(score.distance)
        distance = np.array([float(away(y)) for y in points])
        relative = partial(_relative, of=f"start {seed} of {self._task.name!r}")
        return {
            "image_error": _diverged(relative(gap, "loss above its lowest value")),
            "parameter_error": _diverged(relative(distance, "distance from what is sought")),
            **({} if score.optimum is None else {"gap": _diverged(gap)}),
            "distance": float(distance[-1]),
        }

    def _own_errors(self, points: list[Y], seed: int) -> dict[str, Any]:
        assert self._task.score.errors is not None
        errors, scene = jax.jit(self._task.score.errors), self._task.problem.scene()
        each = [errors(y, scene) for y in points]
        return {name: _diverged([float(one[name]) for one in each]) for name in each[0]}


def _relative(errors: np.ndarray, what: str, of: str) -> np.ndarray:
    """Errors in units of the first, where there is something to reduce."""
    if not 0 < errors[0] < np.inf:
        raise ValueError(
            f"The {what} is {errors[0]:g} at {of}, and errors are relative to that. Begin "
            "elsewhere, or say in Score what the lowest value is (optimum, 0 by default)."
        )
    return errors / errors[0]


def _diverged(errors: Any) -> np.ndarray:
    """The same, infinite where they are NaN: such a run has nothing to show."""
    return np.where(np.isnan(errors), np.inf, errors)


def run(
    task: Task,
    methods: Sequence[Method],
    seeds: Sequence[int],
    folder: Path,
    *,
    setting: str = "quick",
    fresh: bool = False,
    progress: tqdm | bool | None = None,
    keep: Collection[int] = (),
) -> Runs:
    """Runs each method from each start, unless its file is there and is still valid.

    All methods run from one start before the next, so that what else the machine does at the time
    falls on all of them.

    Args:
        task: The task.
        methods: The methods.
        seeds: The starts.
        folder: Where the files of the runs are.
        setting: "quick" or "full", a part of their names.
        fresh: Run again what has been run.
        progress: A bar to go on with; by default one of its own; False is none.
        keep: As for `Runner`.
    """
    runner, found = Runner(task, keep), dict[Method, Any]((method, []) for method in methods)
    with precision_of(task), _bar(progress, len(methods) * len(seeds)) as bar:
        as_it_is = behaviour(task)
        for seed, method in itertools.product(seeds, methods):
            bar.set_description(f"{task.name}: start {seed}, {method.name}")
            path = folder / f"{method.name}-{seed}-{setting}.npz"
            stale = fingerprint(as_it_is, method.source, sorted(keep))
            if isinstance(found[method], list):
                try:
                    made = cached(path, stale, partial(runner, method, seed), fresh)
                    found[method].append(made)
                except NotAble as reason:
                    found[method] = reason
            bar.update()
    return found


def within(evaluations: Sequence[int], most: int) -> int:
    """The last point of a trace that took no more evaluations."""
    return int(np.searchsorted(evaluations, most, side="right")) - 1


def able(runs: Runs) -> dict[Method, list[Run]]:
    """Those of the methods that ran."""
    return {method: found for method, found in runs.items() if isinstance(found, list)}


def flat(y: Y) -> np.ndarray:
    """All parameters as one vector."""
    return np.concatenate([np.ravel(np.asarray(leaf)) for leaf in jax.tree.leaves(y)])


def _bar(progress: tqdm | bool | None, runs: int) -> AbstractContextManager[tqdm]:
    if isinstance(progress, tqdm):
        return nullcontext(progress)
    return tqdm(total=runs, disable=progress is False, unit="run")


def behaviour(task: Task) -> str:
    """Changes when the task does: its settings, and what its black box says at two points."""
    if task.choose is not None:
        task.choose(0)
    problem, score = task.problem, task.score
    points = [y for y in (task.start(0), score.reference) if y is not None]
    said: list[Any] = [task.name, problem.budget, problem.sigma, task.notes]
    said += [fingerprint(*(flat(y) for y in (*points, *problem.bounds)))]
    for fun in (problem.loss, score.distance):
        if fun is not None:
            said += [[flat(fun(y)).tolist() for y in points]]
    if score.errors is not None:
        said.append(flat(jax.jit(score.errors)(points[0], problem.scene())).tolist())
    if problem.gradient is not None:
        slope = jax.jit(problem.gradient)(points[0], jax.random.key(0), problem.scene())
        said.append(float(np.linalg.norm(flat(slope))))
    return repr(said)
