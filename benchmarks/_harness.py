"""Runs methods on a task from many starts, counts, stops, scores, and keeps every run on disk.

A run is one method from one start. It is written as soon as it ends, so that an interrupted
benchmark goes on where it was.
"""

import dataclasses
import hashlib
import itertools
import json
import os
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.flatten_util import ravel_pytree
from tqdm import tqdm

from benchmarks._task import Budget, Loss, Method, NativeAD, NotAble, Solve, Task, Y, precision_of

CLOSED = 1e-8  # the smallest gap that is scored
GROWTH = 1.1  # a trace keeps a point when the evaluations have grown by this factor
WARM_UP_SEED = 1_000_003  # a start that is not in any ensemble
WARM_UP_ITERATIONS = 3

Run = dict[str, Any]


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

    def watch(self, fun: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
        """The same function of y, counted: one for each y, whatever the size of the value."""

        def counted(*y: Y) -> jax.Array:
            value = fun(*y)
            flat = value.ravel()
            out = jax.ShapeDtypeStruct((), value.dtype)
            first = jax.pure_callback(self._let_pass, out, flat[0], vmap_method="expand_dims")
            return flat.at[0].set(first).reshape(value.shape)

        return counted

    def watch_native_ad(self, native_ad: NativeAD) -> NativeAD:
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
        budget: Budget,
        y0: Y,
        iterations: float = np.inf,
        gap: Callable[[Y], float] | None = None,
    ):
        self._counter, self._budget, self._iterations = counter, budget, iterations
        self._gap = gap
        self.trace = [(0, 0.0, _flat(y0))]
        self._last = self.trace[0]
        counter.evaluations = 0
        self._began = time.perf_counter()

    def __call__(self, y: Y) -> None:
        """Takes the y of an iteration; raises Stop after the last one."""
        flat = _flat(y)  # waits for the evaluations behind y
        evaluations = self._counter.evaluations
        seconds = time.perf_counter() - self._began
        self._last = (evaluations, seconds, flat)
        if evaluations >= GROWTH * self.trace[-1][0]:
            self.trace.append(self._last)
        self._iterations -= 1
        spent = evaluations >= self._budget.evaluations or seconds >= self._budget.seconds
        if spent or self._iterations <= 0:
            raise Stop("by the budget")
        if self._gap is not None:
            solved = self._gap(y) <= CLOSED
            self._began += time.perf_counter() - self._began - seconds  # that was not the method's
            if solved:
                raise Stop("at the optimum")

    def finish(self) -> list[tuple[int, float, np.ndarray]]:
        """The points kept, with the last one."""
        if self.trace[-1] is not self._last:
            self.trace.append(self._last)
        return self.trace


def run(
    task: Task,
    methods: Sequence[Method],
    seeds: int,
    folder: Path,
    *,
    setting: str,
    fresh: bool = False,
    progress: bool | tqdm = True,
) -> dict[Method, list[Run] | NotAble]:
    """Runs each method from each start, unless its file is there and is still valid.

    All methods run from one start before the next, so that what else the machine does at the time
    falls on all of them.

    Args:
        task: The task.
        methods: The methods.
        seeds: The number of starts.
        folder: Where the files of the runs are.
        setting: "quick" or "full", a part of their names.
        fresh: Run again what has been run.
        progress: Show a bar, or go on with this one.

    Returns:
        The runs of each method, or why it is not able.
    """
    counter = Counter()
    watched = _watched(task, counter)
    exact_loss = jax.jit(task.exact_loss)
    prepared: dict[Method, tuple[Solve, float]] = {}

    def obtain(method: Method, seed: int) -> Run:
        path = folder / f"{method.name}-{seed}-{setting}.json"
        fingerprint = _hash(behaviour, method.source)
        found = None if fresh else _load(path, fingerprint)
        if found is None:
            if method not in prepared:
                prepared[method] = _warm_up(watched, method, counter)
            solve, warm_up = prepared[method]
            found = {"fingerprint": fingerprint, "warm_up_seconds": warm_up}
            found |= _solve(watched, solve, seed, counter, exact_loss)
            _write(path, found)
        return found

    runs: dict[Method, list[Run]] = {method: [] for method in methods}
    not_able: dict[Method, NotAble] = {}
    with precision_of(task), _bar(progress, len(methods) * seeds) as bar:
        behaviour = _behaviour(task)
        for seed, method in itertools.product(range(seeds), methods):
            bar.set_description(f"{task.name}: start {seed}, {method.name}")
            if method not in not_able:
                try:
                    runs[method].append(obtain(method, seed))
                except NotAble as reason:
                    not_able[method] = reason
            bar.update()
    return runs | not_able


def _bar(progress: bool | tqdm, runs: int) -> AbstractContextManager[tqdm]:
    if isinstance(progress, tqdm):
        return nullcontext(progress)
    return tqdm(total=runs, disable=not progress, unit="run")


def _watched(task: Task, counter: Counter) -> Task:
    """The task as the methods see it: whatever evaluates it is counted."""
    watched: dict[str, Any] = {"loss": counter.watch(task.loss)}
    for name in ("residuals", "terms"):
        if (fun := getattr(task, name)) is not None:
            watched[name] = counter.watch(fun)
    if (grey := task.grey) is not None:
        watched["grey"] = grey._replace(render=counter.watch(grey.render))
        watched["loss"] = watched["grey"].loss
    if (native_ad := task.native_ad) is not None:
        watched["native_ad"] = lambda: counter.watch_native_ad(native_ad())
    return dataclasses.replace(task, **watched)


def _warm_up(task: Task, method: Method, counter: Counter) -> tuple[Solve, float]:
    """Prepares a method and lets it compile on a start of its own, which is not charged to it."""
    began = time.perf_counter()
    solve = method.prepare(task)
    _record(task, solve, WARM_UP_SEED, counter, iterations=WARM_UP_ITERATIONS)
    return solve, time.perf_counter() - began


def _record(
    task: Task,
    solve: Solve,
    seed: int,
    counter: Counter,
    iterations: float = np.inf,
    gap: Callable[[Y], float] | None = None,
) -> tuple[list[tuple[int, float, np.ndarray]], str]:
    """The trace of a run, and why it ended."""
    if task.choose is not None:
        task.choose(seed)
    y0 = task.start(seed)
    recorder = Recorder(counter, task.budget, y0, iterations, gap)
    ended = "by the method"
    try:
        solve(y0, jax.random.key(seed), recorder)
    except Stop as stop:
        ended = str(stop)
    return recorder.finish(), ended


def _solve(task: Task, solve: Solve, seed: int, counter: Counter, exact_loss: Loss) -> Run:
    """One run with its scores. Errors are relative to those of the start, except for the gap."""
    lowest = task.optimum
    above = None if lowest is None else lambda y: float(exact_loss(y)) - lowest
    trace, ended = _record(task, solve, seed, counter, gap=above)
    _, unravel = ravel_pytree(task.reference)
    evaluations, seconds, ys = zip(*trace, strict=True)
    gap = np.array([float(exact_loss(unravel(y))) for y in ys]) - (task.optimum or 0.0)
    sought = _flat(task.reference if task.choose is None else task.choose(seed))
    distance = _distances(task, unravel, ys, sought)
    return {
        "seed": seed,
        "ended": ended,
        "evaluations": list(evaluations),
        "seconds": list(seconds),
        "image_error": (gap / gap[0]).tolist(),
        "parameter_error": (distance / distance[0]).tolist(),
        **({} if task.optimum is None else {"gap": gap.tolist()}),
        "distance": float(distance[-1]),
        "found": ys[-1].tolist(),
    }


def _distances(task: Task, unravel: Callable, ys: Sequence[np.ndarray], sought) -> np.ndarray:
    """How far each point is from the y that is sought, in the task's own sense if it has one."""
    if task.distance is None:
        return np.linalg.norm(np.asarray(ys, float) - sought.astype(float), axis=1)
    distance = jax.jit(task.distance)
    return np.array([float(distance(unravel(y))) for y in ys])


def _flat(y: Y) -> np.ndarray:
    return np.concatenate([np.ravel(np.asarray(leaf)) for leaf in jax.tree.leaves(y)])


def _behaviour(task: Task) -> str:
    """Changes when the task does: its settings, and what its black box says at two points."""
    if task.choose is not None:
        task.choose(0)
    points = task.start(0), task.reference
    losses = [float(task.loss(y)) for y in points]
    bounds = [_flat(y).tolist() for y in (*points, *task.bounds)]
    said = (task.name, task.budget, task.sigma, task.notes, losses, bounds)
    if task.distance is not None:
        said += ([float(task.distance(y)) for y in points],)
    return repr(said)


def _hash(*texts: str) -> str:
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()[:16]


def _load(path: Path, fingerprint: str) -> Run | None:
    if not path.exists():
        return None
    found = json.loads(path.read_text())
    return found if found["fingerprint"] == fingerprint else None


def _write(path: Path, content: Run) -> None:
    """Writes all or nothing, so that a kill leaves no half file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(content))
    os.replace(temporary, path)
