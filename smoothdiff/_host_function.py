"""The user's function as it is called from the host, by a program of its own."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr
from jax.sharding import NamedSharding
from jaxtyping import Array, Float, PyTree

from smoothdiff._flat import Flat
from smoothdiff._layout import Layout
from smoothdiff._problem import Function
from smoothdiff._programs import jit_quickly
from smoothdiff._solvers._evaluator import Evaluator


def evaluator(
    fun: Callable,
    squares: bool,
    args: PyTree,
    layout: Layout,
    size: int | None = None,
    sharding: NamedSharding | None = None,
) -> Evaluator:
    """The function, which returns residuals or not, for parameters of this layout."""
    return Evaluator(Function(fun), args, layout, squares, size, sharding)


def traced(fun: Callable, y: PyTree[Array], args: PyTree) -> tuple[ClosedJaxpr, PyTree]:
    """The function as a program at one point, and the structure of what it returns."""
    fn = Function(fun)
    return jax.make_jaxpr(lambda y: fn(y, args)[0], return_shape=True)(y)


def rows_at(
    evaluate: Flat, points: Float[Array | np.ndarray, "m n"], at_once: int, quick: bool = False
) -> Float[Array, "m P"]:
    """What an evaluator returns at points, so many at once: in a step, and by its program later."""
    rows = _rows_quickly if quick else _rows
    if len(points) <= at_once:
        return rows(evaluate, points)
    parts = [rows(evaluate, points[i : i + at_once]) for i in range(0, len(points), at_once)]
    return jnp.concatenate(parts)


def _rows_of(evaluate: Flat, points: Float[Array | np.ndarray, "K n"]) -> Float[Array, "K P"]:
    return evaluate.tree()(jnp.asarray(points))[0]


# equinox says what its `error_if` says, and keeps JAX from logging what a host function raises
_rows, _rows_quickly = eqx.filter_jit(_rows_of), jit_quickly(_rows_of, eqx.filter_jit)
