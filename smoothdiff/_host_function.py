"""The user's function as it is called from the host, by a program of its own."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr
from jax.sharding import NamedSharding
from jaxtyping import Array, Float, PyTree

from smoothdiff._layout import layout_of
from smoothdiff._programs import QUICKLY
from smoothdiff._solvers._evaluator import Evaluator, called


class _Function(eqx.Module):
    """The user's function as optimistix calls it."""

    fun: Callable[[PyTree, PyTree], Any]

    def __call__(self, y: PyTree, args: PyTree) -> tuple[PyTree[Array], None]:
        return called(self.fun, y, args), None


def evaluator(
    fun: Callable,
    squares: bool,
    args: PyTree,
    y: PyTree[Array],
    size: int | None = None,
    sharding: NamedSharding | None = None,
) -> Evaluator:
    """The function, which returns residuals or not, for parameters like `y`."""
    return Evaluator(_Function(fun), args, layout_of(y), squares, size, sharding)


def traced(fun: Callable, y: PyTree[Array], args: PyTree) -> tuple[ClosedJaxpr, PyTree]:
    """The function as a program at one point, and the structure of what it returns."""
    fn = _Function(fun)
    return jax.make_jaxpr(lambda y: fn(y, args)[0], return_shape=True)(y)


def rows_at(
    evaluate: Evaluator, points: Float[Array, "m n"], at_once: int, quick: bool = False
) -> Float[Array, "m P"]:
    """What the function returns at points, so many at once: in a step, and by its program later."""
    rows = _rows_quickly if quick else _rows
    parts = [rows(evaluate, points[i : i + at_once]) for i in range(0, len(points), at_once)]
    return parts[0] if len(parts) == 1 else jnp.concatenate(parts)


def _rows_of(evaluate: Evaluator, points: Float[Array, "K n"]) -> Float[Array, "K P"]:
    return evaluate(points)[0]


_jit: Any = eqx.filter_jit
_rows, _rows_quickly = _jit(_rows_of), _jit(_rows_of, compiler_options=QUICKLY)
