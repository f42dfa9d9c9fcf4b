"""ZeroGrads as the benchmarks have it, with changes: as a solver, as a method, and step by step."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import optax

import smoothdiff as sd
from benchmarks import _registry
from benchmarks._task import Method, Problem, Y
from benchmarks.methods import zerograds
from benchmarks.methods._host_loop import run_by

# a change of these makes earlier runs stale
LIBRARY = Path(sd.__file__).parent
FILES = (Path(__file__), LIBRARY / "surrogates.py", *sorted(LIBRARY.glob("_solvers/*.py")))
SOURCE = "".join(path.read_text() for path in FILES)


def ours(
    problem: Problem, num_samples: int = zerograds.NUM_SAMPLES, **changes: Any
) -> sd.ZeroGrads:
    """ZeroGrads as the benchmarks have it, but for `changes`."""
    optim = optax.adam(zerograds.rate(problem, num_samples))
    return sd.ZeroGrads(problem.sigma, num_samples=num_samples, optimizer=optim, **changes)


def configuration(name: str, **changes: Any) -> Method:
    """Ours, but for `changes`, as a method."""
    prepare = lambda problem: run_by(sd.minimise, problem, problem.loss, ours(problem, **changes))
    source = _registry.method("zerograds").source + SOURCE + repr(sorted(changes.items()))
    return Method(name, name, prepare, source)


class Steps:
    """The steps of a solver on a problem, for who looks at its state, which `minimise` hides."""

    def __init__(self, solver: Any, problem: Problem):
        self.number = problem.budget.evaluations // solver.evaluations_per_step(problem.like)
        fun = lambda y, args: (problem.loss(y), None)
        options = lambda key: {"key": key, "bounds": problem.bounds}

        @jax.jit
        def init(y, key):
            value = jax.eval_shape(problem.loss, y)
            return solver.init(fun, y, None, options(key), value, None, frozenset())

        @jax.jit
        def step(y, state, key):
            return solver.step(fun, y, None, options(key), state, frozenset())[:2]

        self._init, self._step = init, step

    def __call__(self, y: Y, key: jax.Array) -> Iterator[tuple[Y, Any]]:
        """The parameters and the state, at the start and after each step."""
        state = self._init(y, key)
        yield y, state
        for _ in range(self.number):
            y, state = self._step(y, state, key)
            yield y, state
