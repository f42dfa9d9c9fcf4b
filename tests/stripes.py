"""A task of the tests: two stripes whose brightness is sought; methods; and a registry of these."""

import sys

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import _registry
from benchmarks._task import Budget, MethodEntry, Problem, Score, Task, TaskEntry, Traits

TITLE = "Stripes"
SIDE = 8  # pixels
REFERENCE = np.array([0.25, 0.5], np.float32)  # NumPy does not start JAX


def build(full, **changes):
    """A picture with one stripe of each parameter's brightness."""

    def image(y):
        return jnp.broadcast_to(jnp.repeat(y, SIDE // 2)[:, None, None], (SIDE, SIDE, 3))

    def residuals(y):
        return image(y) - image(REFERENCE)

    problem = Problem(
        loss=lambda y: jnp.sum(residuals(y) ** 2),  # exact, however it is compiled
        residuals=residuals,
        bounds=(jnp.zeros(2), jnp.ones(2)),
        sigma=0.3,
        budget=Budget(evaluations=60, seconds=60),
    )
    return Task(
        name="stripes",
        title=TITLE,
        problem=problem,
        score=Score(REFERENCE, image=image),
        start=lambda seed: jnp.asarray([0.875, 0.125 + 0.0625 * (seed % 4)]),
        seeds=2,
        **changes,
    )


def halving(problem):
    """Halves the distance at each iteration, for one evaluation."""
    loss = jax.jit(problem.loss)

    def solve(y0, key, record):
        y = y0
        for _ in range(8):
            y = (y + REFERENCE) / 2
            loss(y).block_until_ready()
            record(y)

    return solve


def failing(problem):
    raise RuntimeError("no luck\nat all")


def registered(monkeypatch, tasks=None, methods=None):
    """Makes a registry of some tasks, name -> build, and of some methods, name -> prepare."""
    tasks = {"stripes": build} if tasks is None else tasks
    traits = Traits((2,), plateaus=True)
    entries = {n: TaskEntry(n.title(), "scene", build, traits) for n, build in tasks.items()}
    methods = {"halving": halving, "failing": failing} if methods is None else methods
    here = sys.modules[__name__]
    found = {
        name: (here, MethodEntry(name.title(), ("scene",), prepare))
        for name, prepare in methods.items()
    }
    monkeypatch.setattr(_registry, "tasks", lambda: entries)
    monkeypatch.setattr(_registry, "_entries", lambda: found)
    monkeypatch.setenv("COLUMNS", "200")
