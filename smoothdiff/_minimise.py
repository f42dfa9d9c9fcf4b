"""`minimise` and `least_squares`: the host loop over the steps of a solver."""

import os
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import PyTree
from tqdm import tqdm

from smoothdiff._host_calls import BlackBoxError
from smoothdiff._run import Limits, MinimiseError, Problem, Record, Result, Run, inexact
from smoothdiff._solvers import AbstractSmoothSolver


def minimise(
    fun: Callable[[PyTree, PyTree], Any],
    y0: PyTree,
    args: PyTree = None,
    *,
    key: Any,
    solver: optx.AbstractMinimiser,
    max_evaluations: int | None = None,
    max_steps: int | None = None,
    bounds: tuple[PyTree, PyTree] | None = None,
    callback: Callable[[Record], Any] | None = None,
    progress: bool = False,
    checkpoint: str | os.PathLike | None = None,
) -> Result:
    r"""Minimises a smoothed function, one step of a solver at a time.

    $$ \min_y F(y), \qquad F(y) = \mathbb{E}_z[f(y + \sigma z, \text{args})] $$

    The iterates are those of `optimistix.minimise(fun, solver, y0, args, options={"key": key})`,
    with `"bounds": bounds` in the options if there are any. The step is compiled once for each
    function object and solver, so pass the same ones again rather than new lambdas.

    Ctrl-C ends the run, without a further evaluation, and returns what has been found.

    Args:
        fun: the function, `fun(y, args)`, which returns one number. May contain a black box.
        y0: where to start, a pytree of numbers and arrays.
        args: passed on to `fun`.
        key: a random key; the same key gives the same run.
        solver: how to step, such as `FirstOrder(optax.adam(0.1), sigma)`.
        max_evaluations: evaluations of `fun` that are never exceeded. Those that judge the result
            are set aside first, as many as noise would ask for; without noise some are left over.
        max_steps: steps after which to stop. By default 256, or no limit if `max_evaluations` is
            given.
        bounds: a pair (low, high), each a number or a pytree like `y0`. `fun` sees no other points.
        callback: called with each step's `Record`; the run stops if it returns something true.
        progress: show a progress bar.
        checkpoint: a file that keeps the run. The same call takes up the run that it finds there
            and ends with the same result as if there had been no interruption; with a larger
            `max_steps` or `max_evaluations` it goes on. Written as often as is cheap, and at the
            end, whatever ended the run.

    Returns:
        A `Result`.

    Raises:
        MinimiseError: a black box failed, or an estimate was NaN or infinite. Nothing is lost: its
            `result` has what was found, and the checkpoint is written.
        TypeError, ValueError: an argument that cannot work; a checkpoint of another problem.

    Example:
        >>> import jax, jax.numpy as jnp, optax, smoothdiff as sd
        >>> plateaus = lambda y, args: jnp.sum(jnp.floor(4 * jnp.abs(y - args)))
        >>> solver = sd.FirstOrder(optax.adam(0.05), 0.2)
        >>> result = sd.minimise(
        ...     plateaus, jnp.zeros(2), jnp.array([1.0, -2.0]), key=jax.random.key(0), solver=solver
        ... )
        >>> [round(float(y)) for y in result.y]
        [1, -2]
    """
    loop = (max_evaluations, max_steps, bounds, callback, progress, checkpoint)
    _check_solver(solver, optx.AbstractMinimiser, "FirstOrder")
    return _run(fun, y0, args, key, solver, _check_number, *loop)


def least_squares(
    fun: Callable[[PyTree, PyTree], Any],
    y0: PyTree,
    args: PyTree = None,
    *,
    key: Any,
    solver: optx.AbstractLeastSquaresSolver,
    max_evaluations: int | None = None,
    max_steps: int | None = None,
    bounds: tuple[PyTree, PyTree] | None = None,
    callback: Callable[[Record], Any] | None = None,
    progress: bool = False,
    checkpoint: str | os.PathLike | None = None,
) -> Result:
    r"""Minimises a sum of squared residuals, one step of a solver at a time.

    $$ \min_y \tfrac12 \sum_p r_p(y)^2, \qquad r(y) = f(y, \text{args}) $$

    The twin of `minimise` for functions that return residuals, such as an image minus its
    reference: an evaluation teaches all of them, so far fewer are needed. The iterates are those of
    `optimistix.least_squares(fun, solver, y0, args, options={"key": key})`.

    Args:
        fun: the residuals, `fun(y, args)`, an array or a pytree of arrays. May contain a black box.
        y0: where to start, a pytree of numbers and arrays.
        args: passed on to `fun`.
        key: a random key; the same key gives the same run.
        solver: how to step, such as `GaussNewton(sigma)`.
        max_evaluations: as for `minimise`.
        max_steps: as for `minimise`.
        bounds: as for `minimise`.
        callback: as for `minimise`.
        progress: as for `minimise`.
        checkpoint: as for `minimise`.

    Returns:
        A `Result`, whose `fun` is half the sum of squares.

    Raises:
        MinimiseError: a black box failed, or an estimate was NaN or infinite. Nothing is lost: its
            `result` has what was found, and the checkpoint is written.
        TypeError, ValueError: an argument that cannot work; a checkpoint of another problem.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> pixels = jnp.arange(32.0)
        >>> bar = lambda y: jnp.where(jnp.abs(pixels - y) < 4.5, 1.0, 0.0)
        >>> result = sd.least_squares(
        ...     lambda y, photo: bar(y) - photo, 15.0, bar(20.0),
        ...     key=jax.random.key(0), solver=sd.GaussNewton(3.0), max_evaluations=100,
        ... )
        >>> round(float(result.y))
        20
    """
    loop = (max_evaluations, max_steps, bounds, callback, progress, checkpoint)
    _check_solver(solver, optx.AbstractLeastSquaresSolver, "GaussNewton")
    return _run(fun, y0, args, key, solver, _check_residuals, *loop)


def _check_solver(solver: Any, kind: type, example: str) -> None:
    if not isinstance(solver, AbstractSmoothSolver):
        raise TypeError(
            f"solver must be one of smoothdiff's, such as {example}, not {type(solver).__name__}: "
            "others run under optimistix, on smooth(fun, sigma) with a fixed key"
        )
    if not isinstance(solver, kind):
        raise TypeError(
            f"{type(solver).__name__} is not for this: functions that return one number go with "
            "sd.minimise and a solver such as FirstOrder, residuals with sd.least_squares and "
            "GaussNewton"
        )


def _check_number(out: PyTree) -> None:
    leaves = jax.tree.leaves(out)
    if [leaf.shape for leaf in leaves] != [()] or not jnp.issubdtype(leaves[0].dtype, jnp.floating):
        shapes, dtypes = jax.tree.map(lambda a: a.shape, out), jax.tree.map(lambda a: a.dtype, out)
        raise TypeError(
            f"fun returned shape {shapes} and dtype {dtypes}; it must return one real "
            "floating-point number: use jnp.mean(...) or .astype(float), or give residuals to "
            "sd.least_squares"
        )


def _check_residuals(out: PyTree) -> None:
    leaves = jax.tree.leaves(out)
    if not leaves or not all(jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves):
        raise TypeError(
            f"fun returned {out}; it must return residuals, real floating-point arrays: "
            "use .astype(float)"
        )


def _run(
    fun: Callable[[PyTree, PyTree], Any],
    y0: PyTree,
    args: PyTree,
    key: Any,
    solver: Any,
    check: Callable[[PyTree], None],
    max_evaluations: int | None,
    max_steps: int | None,
    bounds: tuple[PyTree, PyTree] | None,
    callback: Callable[[Record], Any] | None,
    progress: bool,
    checkpoint: str | os.PathLike | None,
) -> Result:
    y = jax.tree.map(inexact, y0)
    options = {"key": key} if bounds is None else {"key": key, "bounds": bounds}
    problem = Problem(fun, solver, args, options)
    limits = Limits.of(solver, y, max_steps, max_evaluations)
    run = Run(problem, y, problem.init(y, check))
    if checkpoint is not None:
        run.attach(checkpoint)
    try:
        with tqdm(total=limits.expected, initial=run.steps, disable=not progress) as bar:
            while (reason := run.done() or limits.reached(run)) is None:
                record = run.step()
                text = f"{record.evaluations} evaluations, fun = {record.fun:.4g}"
                bar.set_postfix_str(text, refresh=False)
                bar.update()
                if callback is not None and callback(record):
                    reason = "callback"
                    break
        return run.judged(reason)
    except KeyboardInterrupt:
        return run.found("interrupted")
    except (BlackBoxError, jax.errors.JaxRuntimeError) as error:
        raise MinimiseError(str(error), run.found("failed")) from (error.__cause__ or error)
    finally:
        run.save()
