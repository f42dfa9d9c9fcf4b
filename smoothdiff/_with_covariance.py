"""`with_covariance`: evaluations around an answer that tell the errors of its parameters."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PyTree

from smoothdiff._covariance import Slopes, balance, slopes
from smoothdiff._flat import Flat
from smoothdiff._host_function import evaluator, rows_at, traced
from smoothdiff._layout import layout_of
from smoothdiff._parameter_errors import Answer
from smoothdiff._programs import is_short
from smoothdiff._reraise import reraise
from smoothdiff._result import NO_COVARIANCE, Result, kept_residuals
from smoothdiff._solvers._random_numbers import keyed

# How far from the answer, in standard errors: to the ends of 95 % intervals, and in further calls
# farther, where a jump matters less, or nearer where the function curves. Not so near that slopes
# are those of a ripple: an error is about what holds over its own length.
_ERRORS, _FARTHEST, _NEAREST = 2.0, 4.0, 0.3


def with_covariance(
    fun: Callable[..., Any], result: Result, args: PyTree = None, *, key: Any = None
) -> Result:
    r"""The same result with further evaluations around its answer, for its standard errors.

    $$ y \pm c_k \, s v_k / |J v_k|, \qquad 0.3 \le c_k \le 4, \quad k = 1 \dots n $$

    `Result.covariance` is free: it makes do with the evaluations of the run. Where those do not
    tell the slopes J at the answer, it is NaN and warns. Then call this. It evaluates the residuals
    to both sides of the answer, two standard errors away, along n axes: those of the ellipsoid that
    the errors are known to have.

    While some errors are NaN, call it again. Each further call turns the axes, so that jumps
    average out. It looks up to four standard errors away, and nearer where the residuals curve, but
    not nearer than 0.3 standard errors: slopes over shorter distances are those of jumps and
    ripples, and give errors that are far too small. What stays NaN is not known to be linear over
    its own error; look at it with `plot.slice`.

    Args:
        fun: the residuals, as for `least_squares`.
        result: what that returned.
        args: passed on to `fun`.
        key: a random key, if the function takes one. All of these evaluations get the same key.

    Returns:
        The result with a new `covariance`, and 2 `evaluations` more for each parameter that is not
        at a bound. `y` stays the same, even if one of these evaluations was lower: then the run had
        not converged.

    Raises:
        ValueError: the result has no covariance, as it is of `minimise`, of `LocalGaussNewton` or
            of 100 parameters or more; `fun` returns another number of residuals; a key is missing,
            or given to a function that takes none.
        TypeError: `result` is no result, as where it comes before `fun`.
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
    if not isinstance(result, Result):
        raise TypeError(
            f"result must be what least_squares returned, not {type(result).__name__}: write "
            "sd.with_covariance(fun, result)"
        )
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
        # the history may have dropped the answer
        points = np.concatenate([answer.vector()[None], points])
    units = answer.units
    unit_fun = units.wrap(fun) if any(units.spaces) else fun
    solver, y = result.solver, answer.y
    with reraise():
        evaluate = Flat.of(evaluator(unit_fun, True, args, layout_of(y), solver.batch_size))
        at_once = solver.sizes(y).step
        quick = is_short(traced(unit_fun, y, args)[0], at_once)
        rows = rows_at(evaluate, jnp.asarray(points), at_once, quick)
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
        calls = len(answer.more)
        values, axes = np.linalg.eigh(known.squares[np.ix_(free, free)])
        values = np.maximum(values, np.finfo(float).tiny)
        error = np.sqrt(2 * result.fun / max(size - len(free), 1) / values)
        length = _ERRORS * error
        if calls:
            farthest = min(_ERRORS + calls, _FARTHEST) * error
            length = np.clip(balance(known, values), _NEAREST * error, farthest)
        # neither lost in rounding nor farther than anything that was seen
        length = np.clip(length, np.sqrt(np.finfo(dtype).eps), 1)
        # the same directions again would see the same jumps
        turn = _turned(calls, len(free)) if calls else np.eye(len(free))
        steps = np.zeros((len(free), n))
        steps[:, free] = (length * axes @ turn * known.scale[free, None]).T
    return np.clip(np.concatenate([here + steps, here - steps]).astype(dtype), low, high)


def _turned(seed: int, n: int) -> Float[np.ndarray, "n n"]:
    """Perpendicular directions, drawn at random; the same for the same seed."""
    return np.linalg.qr(np.random.default_rng(seed).standard_normal((n, n)))[0]
