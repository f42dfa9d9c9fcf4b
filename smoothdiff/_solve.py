"""The host loop around the steps of a solver, from what a call says to its result."""

import contextlib
import os
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import optimistix as optx
from jaxtyping import Array, PyTree
from tqdm import tqdm

from smoothdiff._black_box import UnknownOutputError
from smoothdiff._call_checks import check_call, check_solver, check_untraced, explained
from smoothdiff._ctrl_c import ctrl_c_noticed, is_ctrl_c, raise_if_pressed
from smoothdiff._default_solver import default_solver, share_of_range
from smoothdiff._host_problem import HostProblem
from smoothdiff._host_samples import BlackBoxError
from smoothdiff._known import Known
from smoothdiff._limits import Limits
from smoothdiff._numbers import inexact
from smoothdiff._problem import Problem
from smoothdiff._result import Record, Result
from smoothdiff._run import Run
from smoothdiff._solvers import AbstractSmoothSolver
from smoothdiff._solvers._base import write_options
from smoothdiff._solvers._evaluator import called
from smoothdiff._solvers._random_numbers import keyed
from smoothdiff._solvers._wrapped import Wrapped
from smoothdiff._unit_space import UnitSpace

# from so many parameters on, the history does without iterates unless it is asked for them
_MANY = 10_000


class Kind(NamedTuple):
    """What tells a call of `minimise` from one of `least_squares`.

    The class of its solvers with the name of one, and what raises for other functions.
    """

    solvers: type
    example: str
    check: Callable[[PyTree], None]


class Loop(NamedTuple):
    """What is done beside the steps."""

    callback: Callable[[Record], Any] | None
    progress: bool
    keep_iterates: bool | None
    checkpoint: str | os.PathLike | None


def solve(
    kind: Kind,
    fun: Any,
    y0: PyTree,
    args: PyTree,
    key: Any,
    chosen: tuple[Any, PyTree, Any],
    where: tuple[PyTree, Any, bool],
    limits: tuple[Any, ...],
    loop: Loop,
) -> Result:
    """A run of the solver, or of the default one, until it ends.

    Args:
        kind: which of the two calls it is.
        fun: as for these, and so is all that follows.
        y0: the start.
        args: passed on to `fun`.
        key: a random key.
        chosen: solver, sigma and support, None where nothing was chosen.
        where: space, bounds, and whether `fun` takes a key.
        limits: steps, evaluations, seconds and the target.
        loop: the rest.

    Raises:
        MinimiseError, TypeError, ValueError: as `minimise` says.
    """
    (solver, sigma, support), (space, bounds, takes_key) = chosen, where
    residuals = kind.solvers is optx.AbstractLeastSquaresSolver
    name = "least_squares" if residuals else "minimise"
    check_untraced(name, kind.example, (y0, args, key, chosen, where))
    check_call(fun, y0, bounds, space, takes_key)
    fun, args = keyed(fun, args, key) if takes_key else (fun, args)
    units, anywhere = UnitSpace.of(y0, space), sigma is None
    if space is not None:
        fun, y0 = units.wrap(fun), units.unit(y0)
        bounds = units.bounds()
    y = jax.tree.map(inexact, y0)
    if solver is None:
        if space is not None and sigma is None:
            sigma = units.sigma(share_of_range(y, bounds, residuals, support))
        until = limits[-1] is not None and not takes_key
        solver = default_solver(y, bounds, sigma, residuals, support, anywhere, until)
    else:
        check_solver(solver, kind.solvers, kind.example, sigma, support)
        solver = solver if isinstance(solver, AbstractSmoothSolver) else Wrapped(solver)
    options = write_options(key, bounds, takes_key)
    ends = Limits.of(solver, y, *limits)
    with explained():
        if solver.sizes(y) is None:
            problem = Problem(fun, solver, args, options)
        else:
            known = None if takes_key else Known.of(units, y, solver)
            problem = HostProblem.of(fun, solver, args, options, y, known)
        problem, state = _begun(problem, y, kind.check)
    run = Run(problem, problem.here(y), state, units, _keeps(loop.keep_iterates, y))
    with ctrl_c_noticed():
        try:
            return _looped(run, loop, ends)
        except BaseException as error:
            if is_ctrl_c(error):
                return run.found("interrupted")
            if isinstance(error, BlackBoxError | jax.errors.JaxRuntimeError):
                raise run.failed(error) from (error.__cause__ or error)
            raise
        finally:
            run.save()


def _looped(run: Run, loop: Loop, ends: Limits) -> Result:
    """Steps until something ends them."""
    if loop.checkpoint is not None:
        run.attach(loop.checkpoint)
    with tqdm(total=ends.expected, initial=run.steps, disable=not loop.progress) as bar:
        compiled = set()
        while (reason := run.done() or run.reached(ends)) is None:
            if (stage := run.problem.stage(run.state)) not in compiled:
                bar.set_description_str("compiling")
            record = run.step()
            raise_if_pressed()
            compiled.add(stage)
            bar.set_description_str(refresh=False)
            text = f"{record.evaluations} evaluations, fun = {record.fun:.4g}"
            bar.set_postfix_str(text, refresh=False)
            bar.update()
            if loop.callback is not None and loop.callback(record):
                reason = "callback"
                break
    return run.judged(reason, ends.target)


def _keeps(asked: bool | None, y: PyTree[Array]) -> bool:
    """Whether the history has the iterates."""
    return sum(leaf.size for leaf in jax.tree.leaves(y)) < _MANY if asked is None else asked


def _begun(problem: Problem, y: PyTree, check: Callable[[PyTree], None]) -> tuple[Problem, Any]:
    """After an evaluation, if only that can tell what a black box returns."""
    # the evaluation comes after this, so that what it raises has no other error beside it
    with contextlib.suppress(UnknownOutputError):
        return problem.begin(y, check)
    out = called(problem.fun, y, problem.args)
    problem, state = problem.begin(y, check)
    return problem.knowing(out, y, state)
