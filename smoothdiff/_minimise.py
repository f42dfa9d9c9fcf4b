"""`minimise` and `least_squares`: a solver or the default one, until it ends."""

import os
from collections.abc import Callable
from typing import Any

import optimistix as optx
from jaxtyping import PyTree

from smoothdiff._call_checks import (
    check_number,
    check_residuals,
)
from smoothdiff._result import Record, Result
from smoothdiff._solve import Kind, Loop, solve


def minimise(
    fun: Callable[..., Any],
    y0: PyTree,
    args: PyTree = None,
    *,
    key: Any,
    solver: optx.AbstractMinimiser | None = None,
    sigma: PyTree = None,
    target: float | None = None,
    max_evaluations: int | None = None,
    max_steps: int | None = None,
    max_seconds: float | None = None,
    space: PyTree = None,
    bounds: tuple[PyTree, PyTree] | None = None,
    takes_key: bool = False,
    callback: Callable[[Record], Any] | None = None,
    progress: bool = False,
    keep_iterates: bool | None = None,
    checkpoint: str | os.PathLike | None = None,
) -> Result:
    r"""Minimises a smoothed function, one step of a solver at a time.

    $$ \min_y F(y), \qquad F(y) = \mathbb{E}_z[f(y + \sigma z, \text{args})] $$

    The default solver is `NewtonCG(sigma)`, and from 100 parameters on `FirstOrder` with Adam,
    whose steps are 0.15 sigma, `adaptive` unless sigma is a schedule. Default solvers have
    `nonfinite="drop"`: they leave out values that are not finite, unless they are too many.

    The default sigma is a fifth of a parameter's range, or without one a fifth of its start; the
    order of magnitude will do. Numbers of a leaf of y0 that may have the same units share the
    largest of them: those of which, sorted, none is more than ten times the one before. A zero has
    the geometric mean of the others of its leaf. If all are zero, sigma is 0.2. If all first points
    of `NewtonCG` have the same value, or hardly differ beyond rounding, it looks up to a thousand
    sigma away, or within finite bounds anywhere; if it finds a change, it takes the first points
    again. A parameter that changes nothing stays where it was.

    But for rounding, the iterates are those of `optimistix.minimise(fun, solver, y0, args,
    options={"key": key})`, with `"bounds": bounds` in the options if there are any. That runs
    inside of `jit` and `vmap` too; this call does not.

    With fewer than 100 parameters the function is called between steps, which are compiled once for
    all functions. Otherwise a step is compiled for each function object and solver: pass the same
    objects again, not new lambdas.

    Ctrl-C ends the run, without a further evaluation, and returns what has been found.

    Args:
        fun: the function, `fun(y, args)`, which returns one number; a whole one, such as a count,
            becomes a float. May contain a black box.
        y0: where to start, a pytree of finite numbers and arrays.
        args: passed on to `fun`.
        key: a random key; the same key gives the same run.
        solver: how to step, such as `NewtonCG(sigma)` or `FirstOrder(optax.adam(0.1), sigma)`, or
            an optimistix minimiser that is given one of these, such as `BestSoFarMinimiser`.
        sigma: the smoothing width of the default solver, in the units of the parameters: how far
            from y0 to look at first. A number or a pytree like the parameters.
        target: a value that is good enough: the run ends where one as low was seen. If all bounds
            are finite, the default `NewtonCG` or `GaussNewton` has `restarts` with fewer than 100
            parameters, unless `fun` takes a key: one search follows another until then, or a limit.
        max_evaluations: the most evaluations of `fun`, never exceeded. Some are set aside to judge
            the result under noise. Where the function is called between steps, one tells whether it
            has noise, and if not, steps take the others; else they may stay unused. If neither this
            nor `max_steps` is given, the limit is 256 steps. For `NewtonCG` and `GaussNewton` with
            n < 100 parameters it is 200 (n + 1), for all `restarts` together, and what the
            judgement takes. A single search mostly ends before.
        max_steps: steps after which to stop.
        max_seconds: seconds after which no further step begins.
        space: what each parameter may be, such as `Range(1e-3, 10, log=True)`: one space, or a
            pytree like `y0` of spaces and None. The solver then searches in unit coordinates, in
            which sigma is given; `fun`, the records and the result have natural values.
        bounds: a pair (low, high), each a number or a pytree like `y0`. `fun` sees no other points.
        takes_key: whether `fun` draws random numbers. It is called as `fun(y, args, key)`, and its
            mean over keys is minimised, as one fixed key has a minimum of its own. Evaluations that
            are compared get the same key: those of a step or, with fewer than 100 parameters, all
            that the local model compares. Then rounds of samples follow until a limit ends the run.
            `y` is the mean of their centers, unless another point is clearly lower with three fresh
            keys. A black box takes a seed: `lambda y, args, key: box(y, jax.random.bits(key))`.
            Under optimistix args is (args, key), with the option `"takes_key": True`.
        callback: called with each step's `Record`; the run stops if it returns something true.
        progress: show a progress bar. It says "compiling" in the first step of each kind.
        keep_iterates: whether the history has all iterates, by default with fewer than 10,000
            parameters. They take n numbers a step, in memory and in the checkpoint. The callback
            gets each iterate in any case.
        checkpoint: a file that keeps the run. The same call continues the run that it finds there,
            and ends with the same result as without an interruption. With a larger `max_steps` or
            `max_evaluations` it goes on. The file is written as often as is cheap, and at the end,
            whatever ended the run; a warning says if that fails. A run is continued only if the
            call is the same, numbers and code included, and if `fun` gives the same value again at
            the lowest point. That evaluation is not counted; nor are the one that tells what a
            black box without `out` returns, and, where a run goes on after a limit, the few by
            which the result was judged there. A `target` may change, but within bounds not come or
            go, as the default solver would.

    Returns:
        A `Result`.

    Raises:
        MinimiseError: a black box failed, or too much was NaN or infinite. Nothing is lost: its
            `result` has what was found, and the checkpoint is written.
        TypeError, ValueError: an argument that cannot work; a checkpoint of another problem.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> plateaus = lambda y, args: jnp.sum(jnp.floor(4 * jnp.abs(y - args)))
        >>> result = sd.minimise(
        ...     plateaus, jnp.ones(2), jnp.array([1.0, -2.0]), key=jax.random.key(0)
        ... )
        >>> [round(float(y)) for y in result.y]
        [1, -2]

    Source: own; each solver names its own.
    """
    limits = max_steps, max_evaluations, max_seconds, target
    kind = Kind(optx.AbstractMinimiser, "NewtonCG", check_number)
    chosen, where = (solver, sigma, None), (space, bounds, takes_key)
    loop = Loop(callback, progress, keep_iterates, checkpoint)
    return solve(kind, fun, y0, args, key, chosen, where, limits, loop)


def least_squares(
    fun: Callable[..., Any],
    y0: PyTree,
    args: PyTree = None,
    *,
    key: Any,
    solver: optx.AbstractLeastSquaresSolver | None = None,
    sigma: PyTree = None,
    support: Callable[[PyTree], Any] | None = None,
    target: float | None = None,
    max_evaluations: int | None = None,
    max_steps: int | None = None,
    max_seconds: float | None = None,
    space: PyTree = None,
    bounds: tuple[PyTree, PyTree] | None = None,
    takes_key: bool = False,
    callback: Callable[[Record], Any] | None = None,
    progress: bool = False,
    keep_iterates: bool | None = None,
    checkpoint: str | os.PathLike | None = None,
) -> Result:
    r"""Minimises a sum of squared residuals, one step of a solver at a time.

    $$ \min_y \tfrac12 \sum_p r_p(y)^2, \qquad r(y) = f(y, \text{args}) $$

    The twin of `minimise` for functions that return residuals, such as an image minus its
    reference. An evaluation teaches all of them, so far fewer are needed. The iterates are those of
    `optimistix.least_squares(fun, solver, y0, args, options={"key": key})`. Unlike in `minimise`, a
    parameter that changes nothing may end far from its start. Its error is NaN.

    Args:
        fun: the residuals, `fun(y, args)`, an array or a pytree of arrays. May contain a black box.
            Their squares are summed: in float32 they should be between 1e-15 and 1e18.
        y0: where to start, a pytree of finite numbers and arrays.
        args: passed on to `fun`.
        key: a random key; the same key gives the same run.
        solver: how to step, by default `GaussNewton(sigma)`. With a `support` the default is
            `LocalGaussNewton(sigma, support)`; or `LocalCrossEntropy(support)`, if no sigma is
            given, all bounds are finite, the support does not move, and a term has at most ten
            parameters on average. It may be an optimistix solver around one of ours.
        sigma: as for `minimise`. But with fewer than 100 parameters and without a support, the
            default is two fifths of a parameter's range: residuals of points far apart tell most.
            From a start within a tenth of the range from an end it is less, with the root of the
            distance: at the end a tenth of the range.
        support: which residuals each parameter may move, as for `LocalGaussNewton`.
        target: as for `minimise`, a value of half the sum of squares.
        max_evaluations: as for `minimise`.
        max_steps: as for `minimise`.
        max_seconds: as for `minimise`.
        space: as for `minimise`.
        bounds: as for `minimise`.
        takes_key: as for `minimise`; half the sum of squares of the residuals' means is minimised.
        callback: as for `minimise`.
        progress: as for `minimise`.
        keep_iterates: as for `minimise`.
        checkpoint: as for `minimise`.

    Returns:
        A `Result`, whose `fun` is half the sum of squares. With `GaussNewton` and fewer than 100
        parameters it has their `covariance`, `parameter_errors` and `parameter_intervals`. Those
        are NaN if `fun` takes a key, until `with_covariance` has evaluated more with a single one.

    Raises:
        MinimiseError: a black box failed, or too much was NaN or infinite. Nothing is lost: its
            `result` has what was found, and the checkpoint is written.
        TypeError, ValueError: an argument that cannot work; a checkpoint of another problem.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> pixels = jnp.arange(32.0)
        >>> bar = lambda y: jnp.where(jnp.abs(pixels - y) < 4.5, 1.0, 0.0)
        >>> result = sd.least_squares(
        ...     lambda y, photo: bar(y) - photo, 15.0, bar(20.0),
        ...     key=jax.random.key(0), sigma=3.0, max_evaluations=100,
        ... )
        >>> round(float(result.y))
        20

    Source: own; each solver names its own.
    """
    limits = max_steps, max_evaluations, max_seconds, target
    kind = Kind(optx.AbstractLeastSquaresSolver, "GaussNewton", check_residuals)
    chosen, where = (solver, sigma, support), (space, bounds, takes_key)
    loop = Loop(callback, progress, keep_iterates, checkpoint)
    return solve(kind, fun, y0, args, key, chosen, where, limits, loop)
