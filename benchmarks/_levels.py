"""How many evaluations a run takes to bring the image error down to some levels, and no further.

As in `_summary`, errors are relative to the start's, and are looked at when the evaluations have
grown by a tenth. A run ends at the last level, so that this is much cheaper than a whole run.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.flatten_util import ravel_pytree

from benchmarks._cache import cached, fingerprint
from benchmarks._loop import Counter, Recorder, Stop, behaviour
from benchmarks._task import Budget, Method, Solve, Task, precision_of

LEVELS = (0.1, 0.01)  # 90 and 99 percent are gone
Settings = Mapping[str, float]


class Race:
    """Runs of one task, of which only the evaluations count; what has been run is kept.

    Args:
        task: The task. Its seconds do not end a run.
        folder: Where the files of the runs are.
        fresh: Run again what has been run.
    """

    def __init__(self, task: Task, folder: Path, fresh: bool = False):
        self.task, self._folder, self._fresh = task, folder, fresh
        self._counter = Counter()
        endless = Budget(task.problem.budget.evaluations, np.inf)
        self._problem = replace(self._counter.watched(task.problem), budget=endless)
        self._error = jax.jit(lambda y: task.exact_loss(y))  # there may be none
        self._prepared: dict[str, Solve] = {}
        with precision_of(task):
            self._behaviour = behaviour(task)

    @property
    def budget(self) -> int:
        """Evaluations of a run."""
        return self.task.problem.budget.evaluations

    def __call__(
        self, method: Method, seeds: Sequence[int], settings: Settings | None = None
    ) -> np.ndarray:
        """Evaluations to each level, (seeds, levels); infinite where a run never got there.

        Raises:
            NotAble: The method cannot run here.
        """
        settings = dict(settings or {})
        stale = fingerprint(self._behaviour, method.source, LEVELS)
        name = "-".join([method.name, *(f"{key}={settings[key]:.6g}" for key in sorted(settings))])
        rows = []
        with precision_of(self.task):
            for seed in seeds:
                path = self._folder / f"{name}-{seed}.npz"
                make = partial(self._run, method, name, settings, seed)
                rows.append(cached(path, stale, make, self._fresh)["took"])
        return np.array(rows)

    def _run(self, method: Method, name: str, settings: Settings, seed: int) -> dict[str, Any]:
        if name not in self._prepared:
            self._prepared[name] = method.prepare(self._problem, **settings)
        if self.task.choose is not None:
            self.task.choose(seed)
        y0 = self.task.start(seed)
        lowest = self.task.score.optimum or 0.0
        gap = lambda y: float(self._error(y)) - lowest
        return {"took": self._took(self._prepared[name], seed, y0, gap)}

    def _took(self, solve: Solve, seed: int, y0: Any, gap: Callable[[Any], float]) -> np.ndarray:
        recorder = Recorder(self._counter, y0, self._problem.budget)
        unravel: Callable[[Any], Any] = ravel_pytree(self.task.problem.like)[1]
        first, took, points = gap(y0), np.full(len(LEVELS), np.inf), 0
        looked = recorder.last[2]

        def look(y: Any) -> None:
            nonlocal looked
            if np.array_equal(recorder.last[2], looked):
                return  # it stayed where it was
            looked = recorder.last[2]
            there = gap(y) <= np.array(LEVELS) * first
            took[there & np.isinf(took)] = recorder.last[0]

        def record(y):
            nonlocal points
            try:
                recorder(y)
            except Stop:
                look(y)
                raise
            if len(recorder.trace) > points:
                points = len(recorder.trace)
                look(y)
                if np.isfinite(took).all():
                    raise Stop("at the last level")

        with suppress(Stop):
            solve(y0, jax.random.key(seed), record)
            look(unravel(recorder.last[2]))  # it ended by itself
        return took
