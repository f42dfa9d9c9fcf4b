"""A problem as a function of one vector within bounds, as optimisers see it; and their loop."""

import importlib
import itertools
import warnings
from collections.abc import Callable
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from benchmarks._task import Key, NotAble, Problem, Solve, Y


class Flat:
    """The loss, the start and the bounds of a problem in vectors. The loss sees clipped points.

    Attributes:
        problem: The problem.
        size: The number of parameters.
        dtype: Their type.
        low: Their lower bounds, a vector.
        high: Their upper bounds.
        box: Both in NumPy's double precision, two rows.
        unravel: The parameters as the problem has them, as they are.
        value: vector -> number, compiled.
        values: rows -> numbers, compiled, in one call.
    """

    def __init__(self, problem: Problem):
        self.problem = problem
        self.low, self.unravel = ravel_pytree(problem.like)
        self.high, _ = ravel_pytree(problem.bounds[1])
        self.size, self.dtype = self.low.size, self.low.dtype
        self.box = np.asarray([self.low, self.high], float)
        self.value = jax.jit(self.loss)
        self.values = jax.jit(jax.vmap(self.loss))

    def start(self, y0: Y) -> np.ndarray:
        """The start as NumPy's vector, in double precision."""
        return np.asarray(self.clip(ravel_pytree(y0)[0]), float)

    def clip(self, x: jax.Array) -> jax.Array:
        """The nearest point within the bounds."""
        return jnp.clip(x, self.low, self.high)

    def tree(self, x: jax.Array | np.ndarray) -> Y:
        """The parameters as the problem has them, within the bounds."""
        return self.unravel(self.clip(jnp.asarray(x, self.dtype)))

    def loss(self, x: jax.Array) -> jax.Array:
        """The loss of a vector; can be traced."""
        return self.problem.loss(self.tree(x))

    def batch(self, points: Any) -> np.ndarray:
        """The losses of NumPy's rows, in double precision."""
        return np.asarray(self.values(np.asarray(points, self.dtype)), float)

    def iterate(self, step: Callable, init: Callable[[jax.Array], Any]) -> Solve:
        """The loop of `x, state = step(key, i, x, state)`, where x is recorded; i counts from 0.

        Args:
            step: Each call has a key of its own.
            init: The first state, of the start.
        """

        def solve(y0, key, record):
            x = jnp.asarray(self.start(y0), self.dtype)
            state = init(x)
            for i in itertools.count():
                x, state = step(jax.random.fold_in(key, i), i, x, state)
                record(self.tree(x))

        return solve


def seed_of(key: Key) -> int:
    """A seed for random numbers that are not JAX's."""
    return int(jax.random.randint(key, (), 1, 2**31 - 1))


def package(module: str, install: str) -> ModuleType:
    """A package of a competitor, which is imported only by who asks for it."""
    try:
        with warnings.catch_warnings(action="ignore"):  # jaxopt says that it is not maintained
            return importlib.import_module(module)
    except ImportError as error:
        raise NotAble(f"needs a package: pip install {install}") from error
