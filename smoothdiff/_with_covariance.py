"""`with_covariance`: evaluations around an answer that tell the errors of its parameters."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PyTree

from smoothdiff._covariance import Slopes, slopes
from smoothdiff._host_steps import evaluator, rows_at
from smoothdiff._parameter_errors import Answer
from smoothdiff._params import layout_of
from smoothdiff._reraise import reraise
from smoothdiff._result import NO_COVARIANCE, Result, kept_residuals
from smoothdiff._solvers._random_numbers import keyed

# how far from the answer, in standard errors: the ends of 95 % intervals
_ERRORS = 2.0


def with_covariance(
    fun: Callable[..., Any], result: Result, args: PyTree = None, *, key: Any = None
) -> Result:
    r"""The same result with further evaluations around its answer, for its standard errors.

    $$ y \pm 2 s v_k / |J v_k|, \qquad k = 1 \dots n $$

    `Result.covariance` is free, as it makes do with the evaluations of the run. Where those do not
    tell the slopes at the answer, it is NaN and warns. Then this evaluates the residuals two
    standard errors to both sides along each principal axis of the ellipsoid that they are known to
    have. It can be called again, when these are known better: a first call may look too far, where
    the function jumps or curves, and leave NaN. Its warning says so.

    Args:
        fun: the residuals, as for `least_squares`.
        result: what that returned.
        args: passed on to `fun`.
        key: for a function that takes one, which is then the same in all of these evaluations.

    Returns:
        The result with 2 `evaluations` more for each parameter that is not at a bound, and another
        `covariance`. `y` is the same, also if one of these was lower: then the run had not
        converged.

    Raises:
        ValueError: a result without a covariance, of `minimise`, of `LocalGaussNewton` or of 100
            parameters or more; a function with another number of residuals; a key that is missing,
            or given to a function that takes none.
        BlackBoxError: an evaluation failed.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> t = jnp.linspace(0.0, 3.0, 30)
        >>> data = 2 * jnp.exp(-t) + 0.1 * jax.random.normal(jax.random.key(0), t.shape)
        >>> fun = lambda y, data: y[0] * jnp.exp(-y[1] * t) - data
        >>> result = sd.least_squares(fun, jnp.ones(2), data, key=jax.random.key(1))
        >>> result = sd.with_covariance(fun, result, data)
        >>> print(result.parameter_errors.round(2))
        [0.07 0.05]

    Source: own.
    """
    answer, history = result.answer, kept_residuals(result)
    if answer is None or history is None:
        raise ValueError(NO_COVARIANCE)
    took_key = result.state.search.average is not None
    if took_key != (key is not None):
        raise ValueError(
            "the function of this result takes a key: write key=jax.random.key(0)"
            if took_key
            else "the function of this result takes no key: leave key out"
        )
    fun, args = keyed(fun, args, key) if took_key else (fun, args)
    size = history.rows.shape[1]
    before, values, here = answer.evaluations(history)
    points = _around(result, answer, slopes(before, values, here), size)
    if here is None:
        # of several searches only the last one is kept
        points = np.concatenate([answer.vector()[None], points])
    units = answer.units
    unit_fun = units.wrap(fun) if any(units.spaces) else fun
    solver, y = result.solver, answer.y
    with reraise():
        evaluate = evaluator(unit_fun, True, args, y, solver.batch_size)
        rows = rows_at(evaluate, jnp.asarray(points), solver.sizes(y).step)
        rows = jax.block_until_ready(rows)
    if rows.shape[1] != size:
        raise ValueError(f"fun returned {rows.shape[1]} residuals, and {size} in the run")
    evaluations = result.evaluations + len(points)
    return dataclasses.replace(
        result, evaluations=evaluations, answer=answer.with_rows(points, rows)
    )


def _around(
    result: Result, answer: Answer, known: Slopes | None, size: int
) -> Float[np.ndarray, "m n"]:
    """The points, one sigma away along each parameter if nothing is known."""
    here, low, high = answer.vector(), *answer.sides()
    free = np.flatnonzero((low < here) & (here < high))
    dtype, n = here.dtype, len(here)
    if known is None:
        layout = layout_of(answer.y)
        sigma = layout.vector(jax.tree.leaves(jax.tree.broadcast(result.solver.sigma, answer.y)))
        steps = np.diag(np.asarray(sigma))[free]
    else:
        values, axes = np.linalg.eigh(known.squares[np.ix_(free, free)])
        squares = 2 * result.fun / max(size - len(free), 1)
        error = np.sqrt(squares / np.maximum(values, np.finfo(float).tiny))
        # neither lost in rounding nor farther than anything that was seen
        length = np.clip(_ERRORS * error, np.sqrt(np.finfo(dtype).eps), 1)
        steps = np.zeros((len(free), n))
        steps[:, free] = (length * axes * known.scale[free, None]).T
    return np.clip(np.concatenate([here + steps, here - steps]).astype(dtype), low, high)
