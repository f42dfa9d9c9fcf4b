"""`recommend`: in words, what to choose for a function, and what it looks like around a start."""

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from smoothdiff._black_box import UnknownOutputError
from smoothdiff._call_checks import check_call, check_number, check_residuals, explained
from smoothdiff._default_solver import default_solver, share_of_range
from smoothdiff._flat import Flat
from smoothdiff._host_function import evaluator, rows_at
from smoothdiff._limits import Limits
from smoothdiff._look_around import WIDEST, View, look_around
from smoothdiff._numbers import inexact
from smoothdiff._params import as_key, take_apart
from smoothdiff._reraise import reraise
from smoothdiff._solvers._base import write_options
from smoothdiff._solvers._evaluator import called
from smoothdiff._solvers._random_numbers import in_step, keyed
from smoothdiff._unit_space import UnitSpace

# with so many parameters or more, so many random directions instead of each parameter
_MANY, _DIRECTIONS = 100, 8
# effects that differ by more are of other scales; changes of less than so many times the noise are
# not seen
_SCALES, _SEEN = 1e3, 3.0
_LISTED = 6


@dataclasses.dataclass(frozen=True)
class Recommendation:
    """What `recommend` says; `print` it.

    Attributes:
        solver: to pass to the function `run`.
        sigma: its smoothing width, in unit coordinates where there is a space.
        run: "least_squares" or "minimise".
        max_evaluations: the limit of a run that is given none; usually it ends before.
        seen: what the samples showed.
        advice: what to try.
        evaluations: of the function, for this.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> advice = sd.recommend(lambda y, args: jnp.sum(y**2), jnp.ones(2), key=jax.random.key(0))
        >>> advice.run, type(advice.solver).__name__
        ('minimise', 'NewtonCG')

    Source: own.
    """

    solver: Any = dataclasses.field(repr=False)
    sigma: PyTree
    run: str
    max_evaluations: int
    seen: tuple[str, ...]
    advice: tuple[str, ...]
    evaluations: int

    def __str__(self) -> str:
        leaves, _ = jax.tree_util.tree_flatten_with_path(self.sigma)
        widths = [
            f"{jax.tree_util.keystr(path, simple=True, separator='.')} {_number(leaf)}".strip()
            for path, leaf in leaves
        ]
        lines = [
            f"sd.{self.run} with {type(self.solver).__name__}, sigma {', '.join(widths)}, at most "
            f"{self.max_evaluations} evaluations",
            f"Seen at {self.evaluations} evaluations around y0:",
            *(f"- {line}" for line in self.seen),
            "To try:",
            *(f"- {line}" for line in self.advice),
        ]
        return "\n".join(lines)


def recommend(
    fun: Callable[..., Any],
    y0: PyTree,
    args: PyTree = None,
    *,
    key: Any,
    sigma: PyTree = None,
    space: PyTree = None,
    bounds: tuple[PyTree, PyTree] | None = None,
    takes_key: bool = False,
) -> Recommendation:
    """Says what to choose for a function, what it looks like around y0, and what to try.

    The run is `least_squares` if `fun` returns residuals, and `minimise` if it returns one number.
    Solver and sigma are those which that would choose, with two exceptions: sigma is wider where
    nothing changes within it, and the solver leaves out values that are not finite, if it saw any.

    It evaluates y0 twice, and points one sigma to both sides along each parameter; with 100
    parameters and more, along 8 random directions. If nothing changes, up to 6 evaluations follow,
    up to 64 sigma away. Where something changes, 6 between there and y0 tell jumps from slopes. In
    all it takes at most 2 n + 14 evaluations, where n is 8 for many parameters, or 2 n + 4 if there
    is noise.

    Args:
        fun: the function, `fun(y, args)`: one number, or residuals. May contain a black box.
        y0: where to start, a pytree of numbers and arrays.
        args: passed on to `fun`.
        key: a random key.
        sigma: as for `minimise`.
        space: as for `minimise`.
        bounds: as for `minimise`.
        takes_key: as for `minimise`. Each evaluation has a key of its own, so that noise is seen.

    Returns:
        A `Recommendation`.

    Raises:
        TypeError, ValueError: an argument that cannot work, as for `minimise`.
        BlackBoxError: an evaluation failed.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> pixels = jnp.arange(32.0)
        >>> bar = lambda y, photo: jnp.where(jnp.abs(pixels - y) < 4.5, 1.0, 0.0) - photo
        >>> advice = sd.recommend(bar, 15.0, jnp.zeros(32), key=jax.random.key(0))
        >>> advice.run, float(advice.sigma), advice.evaluations
        ('least_squares', 3.0, 10)
        >>> advice.seen[-1]
        'the function jumps, or has ripples: its changes do not vanish over short distances'

    Source: own.
    """
    check_call(fun, y0, bounds, space, takes_key)
    fun, args = keyed(fun, args, key) if takes_key else (fun, args)
    units = UnitSpace.of(y0, space)
    if space is not None:
        fun, y0, bounds = units.wrap(fun), units.unit(y0), units.bounds()
    y = jax.tree.map(inexact, y0)
    squares, spent = _residuals(fun, y, args)
    if space is not None and sigma is None:
        sigma = units.sigma(share_of_range(y, bounds, squares))
    solver = default_solver(y, bounds, sigma, squares)
    params = take_apart(y, solver.sigma, bounds)
    n = params.theta.size
    one, other = jax.random.split(as_key(key))
    each = n < _MANY
    shape = _DIRECTIONS, n
    directions = np.eye(n) if each else np.asarray(jax.random.rademacher(one, shape)) / n**0.5
    further = np.asarray(jax.random.normal(other, (n,)))
    options, numbers = write_options(key, None, takes_key), itertools.count()

    def row(point: np.ndarray) -> np.ndarray:
        seen = in_step(args, options, next(numbers))
        evaluate = Flat.of(evaluator(fun, squares, seen, params.layout))
        return np.asarray(rows_at(evaluate, jnp.asarray(point)[None], 1)[0])

    def rows(points: np.ndarray) -> np.ndarray:
        with reraise():
            return np.stack([row(point) for point in points])

    dtype = params.theta.dtype
    view = look_around(
        rows,
        np.asarray(params.theta),
        np.asarray(params.sigma),
        lambda points: np.asarray(jax.vmap(params.clip)(jnp.asarray(points, dtype))),
        directions,
        further / np.linalg.norm(further),
    )
    if view.width > 1:
        wider = jax.tree.map(lambda s: s * view.width, solver.sigma)
        solver = default_solver(y, bounds, wider, squares)
    names = units.labels() if each else [f"direction {i}" for i in range(_DIRECTIONS)]
    seen, advice = _words(view, names, squares, n)
    limits = Limits.of(solver, y, None, None, None, None)
    steps = limits.expected or 0
    return Recommendation(
        solver=solver,
        sigma=solver.sigma,
        run="least_squares" if squares else "minimise",
        max_evaluations=steps * solver.evaluations_per_step(y) + solver.final_evaluations(y),
        seen=tuple(seen),
        advice=tuple(advice),
        evaluations=view.evaluations + spent,
    )


def _residuals(fun: Callable, y: PyTree, args: PyTree) -> tuple[bool, int]:
    """Whether the function returns residuals, and how many evaluations it took to know."""
    spent, shapes = 0, lambda: jax.eval_shape(lambda y: called(fun, y, args), y)
    with explained():
        try:
            out = shapes()
        except UnknownOutputError:
            # only an evaluation tells what a black box returns
            fun(y, args)
            out, spent = shapes(), 1
    squares = [leaf.shape for leaf in jax.tree.leaves(out)] != [()]
    (check_residuals if squares else check_number)(out)
    return squares, spent


def _words(view: View, names: list[str], squares: bool, n: int) -> tuple[list[str], list[str]]:
    """What was seen, and what to try."""
    seen, advice, effects = [], [], view.effects
    if not view.finite:
        other = "another y0, unless the function is finite around this one: then a search can begin"
        return ["the function is not finite at y0"], [other]
    known = effects > _SEEN * view.noise
    if view.noise:
        beside = f"beside changes of {np.max(effects):.2g} within sigma"
        seen.append(f"noise: the same point twice differs by {view.noise:.2g}, {beside}")
        if not np.any(known):
            advice.append("a larger sigma: within this one there is nothing but noise")
        else:
            advice.append("a target or max_evaluations, as noise ends a run late")
    else:
        seen.append("no noise: the same point twice gives the same")
    if view.width == 1 and n < _MANY:
        order = np.argsort(-effects, kind="stable")
        amounts = [f"{names[j]} {effects[j]:.2g}" for j in order[:_LISTED]]
        more = ", ..." if len(order) > _LISTED else ""
        seen.append(f"changes within sigma: {', '.join(amounts)}{more}")
    if view.width > 1:
        seen.append(f"a plateau: nothing changes within sigma, but {view.width:g} times as far")
        advice.append(f"this solver, whose sigma is {view.width:g} times the usual one")
    elif not view.width and not np.all(np.isnan(view.changes)):
        seen.append(f"a plateau: nothing changes within {WIDEST:g} sigma")
        advice.append("another y0, a far larger sigma, or a look at whether fun uses y at all")
    elif not np.all(known | view.failed):
        idle = _listed(names, ~known & ~view.failed)
        amount = "no more than noise does" if view.noise else "nothing, or less than rounding"
        seen.append(f"{idle} changes {amount}")
        advice.append(f"a larger sigma for {idle}; what never matters is better off in args")
    if np.any(view.failed):
        seen.append(f"values that are not finite along {_listed(names, view.failed)}")
        advice.append("bounds within which they are; this solver leaves out what is not finite")
    strong, weak = np.argmax(effects), np.argmin(np.where(known, effects, np.inf))
    if effects[strong] > _SCALES * effects[weak] > 0:
        ratio = effects[strong] / effects[weak]
        seen.append(
            f"scales that differ: {names[strong]} changes the function {ratio:.0e} times as much "
            f"as {names[weak]}"
        )
        advice.append(
            f"a smaller sigma for {names[strong]} or a larger one for {names[weak]}, if these are "
            "not in the same units: sigma like y0, or a space"
        )
    if view.jumps:
        seen.append(
            "the function jumps, or has ripples: its changes do not vanish over short distances"
        )
        advice.append("no smaller sigma than the jumps are apart")
    elif view.jumps is not None:
        seen.append("smooth where it was looked at")
    if not squares:
        advice.append("sd.least_squares on the residuals, if it is a sum of squares: far cheaper")
    if n >= _MANY and squares:
        advice.append("support, if each parameter moves few residuals")
    return seen, advice or ["the call as it is"]


def _listed(names: list[str], chosen: np.ndarray) -> str:
    found = [name for name, take in zip(names, chosen, strict=True) if take]
    return ", ".join(found[:_LISTED]) + (", ..." if len(found) > _LISTED else "")


def _number(leaf: Any) -> str:
    values = np.asarray(leaf)
    if values.size and np.all(values == values.flat[0]):
        return f"{values.flat[0]:.3g}"
    return np.array2string(values, precision=3, threshold=_LISTED, separator=", ")
