"""A task as a function of one vector within bounds, as the libraries of optimisers see it."""

import importlib
import warnings
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from benchmarks._task import NotAble, Record, Task, Y


class Flat:
    """The loss, the start and the bounds of a task in flat vectors. The loss sees clipped points.

    Attributes:
        size: The number of parameters.
        dtype: Their type.
        low: Their lower bounds, a vector.
        high: Their upper bounds.
        value: vector -> number, compiled.
        values: rows -> numbers, compiled, in one call.
    """

    def __init__(self, task: Task):
        reference, self._unravel = ravel_pytree(task.reference)
        self.size, self.dtype = reference.size, reference.dtype
        self.low, self.high = (
            ravel_pytree(jax.tree.map(_fill, task.reference, bound))[0] for bound in task.bounds
        )
        self._loss = task.loss
        self.value = jax.jit(self.loss)
        self.values = jax.jit(jax.vmap(self.loss))

    def start(self, y0: Y) -> np.ndarray:
        """The start as NumPy's vector, in double precision."""
        return np.asarray(self.clip(ravel_pytree(y0)[0]), float)

    def clip(self, x: jax.Array) -> jax.Array:
        """The nearest point within the bounds."""
        return jnp.clip(x, self.low, self.high)

    def tree(self, x: jax.Array | np.ndarray) -> Y:
        """The parameters as the task has them, within the bounds."""
        return self._unravel(self.clip(jnp.asarray(x, self.dtype)))

    def loss(self, x: jax.Array) -> jax.Array:
        """The loss of a vector; can be traced."""
        return self._loss(self.tree(x))


class OneByOne:
    """The loss for libraries on the host: a number for a vector, recorded after each evaluation.

    What it records is the best point so far, by what the evaluations said.
    """

    def __init__(self, flat: Flat, record: Record):
        self._flat, self._record = flat, record
        self._lowest, self._best = np.inf, None

    def __call__(self, x: np.ndarray) -> float:
        """Evaluates one point."""
        value = float(self._flat.value(np.asarray(x, self._flat.dtype)))
        if self._best is None or value < self._lowest:
            self._lowest, self._best = value, self._flat.tree(x)
        self._record(self._best)
        return value


def package(module: str, install: str) -> ModuleType:
    """A package of a competitor, which is imported only by who asks for it."""
    try:
        with warnings.catch_warnings(action="ignore"):  # jaxopt says that it is not maintained
            return importlib.import_module(module)
    except ImportError as error:
        raise NotAble(f"needs a package: pip install {install}") from error


def _fill(leaf: jax.Array, bound: jax.Array) -> jax.Array:
    leaf = jnp.asarray(leaf)
    return jnp.broadcast_to(jnp.asarray(bound, leaf.dtype), leaf.shape)
