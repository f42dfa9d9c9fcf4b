"""What is chosen where the user chooses nothing: the solver and its sigma."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.typing import ArrayLike
from jaxtyping import Array, PyTree

from smoothdiff._numbers import check_real
from smoothdiff._params import check_pair, like
from smoothdiff._solvers import (
    FirstOrder,
    GaussNewton,
    LocalCrossEntropy,
    LocalGaussNewton,
    NewtonCG,
)
from smoothdiff._solvers._base import sigma_at
from smoothdiff._spaces import SIGMA
from smoothdiff._support import MovingSupport, as_support

# sigma as a share of the scale of a parameter without a range; the next larger number has the same
# units if it is no more than so many times as large
_SHARE, _ALIKE = 0.2, 10.0
# and of a range for residuals that are evaluated point by point: first points far apart tell most
_WIDE = 0.4
# a start within the first share of a range from its end says that the range is wide beside what is
# known: there sigma falls with the root of the distance, to the second share of the usual one
_EDGE, _LEAST = 0.1, 0.25
# a step of Adam, in sigmas
_RATE = 0.15
# searches that may follow until a target is reached: more than any limit allows
_UNTIL = 2**30
# so many parameters on a term, in the mean, can be searched for by themselves
_FEW = 10


def share_of_range(
    y: PyTree[Array],
    bounds: tuple[PyTree, PyTree] | None,
    residuals: bool,
    support: Callable[[PyTree], Array] | None = None,
) -> PyTree:
    """The default sigma of each parameter as a share of its range.

    Args:
        y: where to start, in the coordinates of the bounds.
        bounds: the pair (low, high), None where there are none.
        residuals: whether residuals are minimised, rather than a number.
        support: which residuals each parameter may move, if that is known.

    Returns:
        For each leaf a number, or an array of its shape and dtype.
    """
    leaves, treedef = jax.tree.flatten(y)
    if not residuals or support is not None or GaussNewton(1.0).sizes(y) is None:
        return treedef.unflatten([SIGMA] * len(leaves))
    return treedef.unflatten(map(_wide, leaves, *_sides(y, bounds)))


def default_solver(
    y: PyTree[Array],
    bounds: tuple[PyTree, PyTree] | None,
    sigma: PyTree | None,
    residuals: bool,
    support: Callable[[PyTree], Array] | None = None,
    anywhere: bool = False,
    until: bool = False,
) -> Any:
    """The rule that `minimise` and `least_squares` state.

    `anywhere` says that no sigma is the user's, who does not ask to look around the start; `until`
    that there is a target, so that one search follows another where all is bounded. What fails is
    left out, as nobody chose where the points are.
    """
    all_bounded = _all_bounded(y, bounds)
    usual = _usual(y, bounds, share_of_range(y, bounds, residuals, support))
    if sigma is None:
        sigma = usual
    elif not callable(sigma):
        full = like(sigma, y, "sigma")
        # as floats, as JAX has no integers of any size
        sigma = jax.tree.map(lambda s: float(s) if type(s) is int else s, sigma, is_leaf=_is_none)
        if any(width is None for width in jax.tree.leaves(sigma, is_leaf=_is_none)):
            # what a space says nothing of
            sigma = jax.tree.map(lambda s, d: d if s is None else s, full, usual, is_leaf=_is_none)
    # one search by batches takes the evaluations of many point by point
    by_points = GaussNewton(sigma).sizes(y) is not None
    restarts = _UNTIL if until and by_points and all_bounded else 0
    if residuals:
        if support is None:
            return GaussNewton(sigma, restarts=restarts, nonfinite="drop")
        if anywhere and all_bounded and _few_on_a_term(y, support):
            return LocalCrossEntropy(support, nonfinite="drop")
        return LocalGaussNewton(sigma, support, nonfinite="drop")
    # with more parameters a quadratic model takes too many evaluations
    if NewtonCG(1.0).sizes(y) is not None:
        return NewtonCG(sigma, restarts=restarts, nonfinite="drop")
    optim = optax.chain(optax.scale_by_adam(), _in_sigmas(sigma))
    return FirstOrder(optim, sigma, adaptive=not callable(sigma), nonfinite="drop")


def _usual(y: PyTree[Array], bounds: tuple[PyTree, PyTree] | None, share: PyTree) -> PyTree[Array]:
    """These shares of each range; without one a fifth of the parameter's scale."""
    leaves, treedef = jax.tree.flatten(y)
    shares = treedef.flatten_up_to(share)
    return treedef.unflatten(map(_width, leaves, shares, *_sides(y, bounds)))


def _sides(y: PyTree[Array], bounds: tuple[PyTree, PyTree] | None) -> tuple[list, list]:
    """The bounds of each leaf, None where it has none."""
    if bounds is None:
        bounds = None, None
    check_pair(bounds)
    low, high = bounds
    treedef = jax.tree.structure(y)
    lows, highs = (treedef.flatten_up_to(like(side, y, "bounds")) for side in (low, high))
    for side in (*lows, *highs):
        if side is not None:
            check_real(side, "bounds")
    return lows, highs


def _all_bounded(y: PyTree[Array], bounds: tuple[PyTree, PyTree] | None) -> bool:
    """Whether each parameter has two finite ends."""
    return all(
        side is not None and bool(np.all(np.isfinite(side)))
        for sides in _sides(y, bounds)
        for side in sides
    )


def _few_on_a_term(y: PyTree[Array], support: Any) -> bool:
    """Whether the support stays where it is, and few parameters move a term."""
    support = as_support(support)
    if support is None or isinstance(support, MovingSupport):
        return False
    on_each = np.asarray(support(jax.tree.map(jnp.ones_like, y)))
    return bool(np.sum(on_each) <= _FEW * np.count_nonzero(on_each))


def _is_none(leaf: Any) -> bool:
    return leaf is None


def _in_sigmas(sigma: PyTree) -> optax.GradientTransformation:
    """A step of so many sigmas of each parameter, downhill; sigma may be a schedule."""
    if callable(sigma):
        return optax.scale_by_schedule(lambda step: -_RATE * sigma_at(sigma, jnp.asarray(step)))

    def update(updates: PyTree[Array], _: PyTree) -> PyTree[Array]:
        widths = jax.tree.broadcast(sigma, updates)
        return jax.tree.map(lambda u, s: (-_RATE * s * u).astype(u.dtype), updates, widths)

    return optax.stateless(update)


def _width(leaf: Array, share: ArrayLike, low: Any, high: Any) -> Array:
    width = jnp.asarray(_SHARE * _sizes(np.asarray(leaf)), leaf.dtype)
    if low is None or high is None:
        return width
    span = jnp.broadcast_to(jnp.asarray(high) - jnp.asarray(low), leaf.shape).astype(leaf.dtype)
    return jnp.where(jnp.isfinite(span) & (span > 0), share * span, width)


def _wide(leaf: Array, low: Any, high: Any) -> np.ndarray | float:
    """The share for residuals: less where the start is near an end."""
    if low is None or high is None:
        return _WIDE
    y, low, high = (np.asarray(a, float) for a in (leaf, low, high))
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        inside = np.where(np.isfinite(high - low), np.minimum(y - low, high - y) / (high - low), 1)
    near = np.clip(np.sqrt(np.fmax(inside, 0) / _EDGE), _LEAST, 1)
    if np.all(near == 1):
        return _WIDE
    return np.broadcast_to(_WIDE * near, leaf.shape).astype(leaf.dtype)


def _sizes(leaf: np.ndarray) -> np.ndarray:
    """The scale of each number: the largest of those that may have the same units.

    Sorted, they have where none is more than ten times the one before. A zero has the geometric
    mean of all others, or 1.
    """
    sizes = np.abs(leaf).astype(float)
    some = np.sort(sizes[sizes >= float(jnp.finfo(leaf.dtype).tiny)])
    if not len(some):
        return np.ones_like(sizes)
    largest = np.append(np.flatnonzero(some[1:] > _ALIKE * some[:-1]), len(some) - 1)
    # no number has no group, and nobody takes it for a sigma
    group = np.minimum(np.searchsorted(some[largest], sizes), len(largest) - 1)
    usual = np.where(sizes < some[0], np.exp(np.mean(np.log(some))), some[largest[group]])
    return np.where(np.isnan(sizes), sizes, usual)
