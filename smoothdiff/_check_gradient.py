"""Whether a gradient, of whatever origin, is that of a function with noise or jumps."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from smoothdiff._numbers import check_whole, inexact
from smoothdiff._params import Params, as_key, take_apart

# a gradient that is known to this share of its largest entry is known well enough; where it nearly
# vanishes, as in a minimum, to this share of that of single points
_ENOUGH, _NEARLY = 0.1, 0.01
# pairs for each parameter from which on a linear fit to them is better than none
_EACH = 2
# the fewest evaluations whose spread says something
_FEWEST = 32


@dataclasses.dataclass(frozen=True)
class GradientCheck:
    """What `check_gradient` found, with pytrees like the parameters.

    Attributes:
        wrong: where the gradient differs from that of the function by more than chance allows.
        undecided: where it may be right, but is known to no better than a tenth of the largest
            entry, nor a hundredth of what it is at single points; more samples decide. Of a
            function that has one value at all points a gradient of zero is right.
        difference: the gradient less that of the function, both smoothed.
        low: the lower end of the interval of `difference`.
        high: the upper end.
        gradient: what it should be, the gradient of the smoothed function.
        level: the chance that a right gradient is called wrong in any entry.
        evaluations: evaluations of the function, and as many of the gradient.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> steps = jax.jit(lambda y: jnp.sum(y**2 + jnp.floor(y[0])))
        >>> by_ad, y = jax.jit(jax.grad(steps)), jnp.ones(2)
        >>> check = sd.check_gradient(by_ad, steps, y, 0.5, key=jax.random.key(0))
        >>> check.passed, [bool(wrong) for wrong in check.wrong]
        (False, [True, False])

    Source: own.
    """

    wrong: PyTree[np.ndarray]
    undecided: PyTree[np.ndarray]
    difference: PyTree[np.ndarray]
    low: PyTree[np.ndarray]
    high: PyTree[np.ndarray]
    gradient: PyTree[np.ndarray]
    level: float
    evaluations: int

    @property
    def passed(self) -> bool:
        """Whether all entries are right, and known well enough."""
        bad = jax.tree.leaves((self.wrong, self.undecided))
        return not any(np.any(leaf) for leaf in bad)

    def __str__(self) -> str:
        """A line for each entry, those that are wrong first; at most twenty."""
        parts = self.wrong, self.undecided, self.gradient, self.difference, self.low, self.high
        named, _ = jax.tree_util.tree_flatten_with_path(self.gradient)
        names = [
            f"y{jax.tree_util.keystr(path)}" + (str(list(map(int, at))) if leaf.ndim else "")
            for path, leaf in named
            for at in np.ndindex(leaf.shape)
        ]
        columns = [np.concatenate([np.ravel(x) for x in jax.tree.leaves(part)]) for part in parts]
        words = np.where(columns[0], "wrong", np.where(columns[1], "undecided", "right"))
        order = np.argsort(2 * ~columns[0] - columns[1], kind="stable")
        lines = [
            f"{names[i]}: {words[i]}, should be {columns[2][i]:.4g}, is off by "
            f"{columns[3][i]:.2g} [{columns[4][i]:.2g}, {columns[5][i]:.2g}]"
            for i in order[:20]
        ]
        more = [f"and {len(order) - 20} more"] if len(order) > 20 else []
        return "\n".join([*lines, *more])


def check_gradient(
    grad_fun: Callable[[PyTree], PyTree],
    fun: Callable[[PyTree], Any],
    y: PyTree,
    sigma: PyTree,
    *,
    key: Any,
    num_samples: int = 1024,
    level: float = 0.05,
) -> GradientCheck:
    r"""Checks whether a gradient is that of a function, like `jax.test_util.check_grads`.

    $$ \mathbb{E}_z[g(y + \sigma z)] = \nabla_y \, \mathbb{E}_z[f(y + \sigma z)]
       = \mathbb{E}_z\left[\frac{f(y + \sigma z) - f(y - \sigma z)}{2 \sigma} z\right] $$

    The first equation holds if and only if g is the whole derivative of f, with what moving edges
    and jumps add. AD leaves that out, and so do renderers without boundary terms. The function may
    have noise and jumps. Both sides are estimated from the same pairs of points, and an interval of
    their difference decides: for each entry the gradient is right, wrong, or undecided.

    All intervals together hold with probability 1 - `level`. From each half of the samples a linear
    fit to the other half is subtracted, so a nearly linear function needs few samples.

    Both functions are called point by point, outside of JAX's transforms. So they may be compiled
    by `jax.jit`, and may be any Python functions.

    Args:
        grad_fun: y -> the gradient to check, a pytree like y: from AD, from a renderer, or written
            by hand.
        fun: y -> a number.
        y: where to check, a pytree of numbers and arrays.
        sigma: how far around y to look, in the units of the parameters: a number or a pytree like
            y. A jump further away than a few sigma is not seen.
        key: a random key.
        num_samples: evaluations of the function, and of the gradient; at least 32.
        level: how often a right gradient may be called wrong.

    Returns:
        A `GradientCheck`, which prints as a table; `passed` says all in one word.

    Raises:
        ValueError: too few samples, a gradient of another structure or shape than y, a value that
            is not finite.
        TypeError: `num_samples` is no whole number.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> steps = jax.jit(lambda y: y**2 + jnp.floor(y))
        >>> by_ad, whole = jax.jit(jax.grad(steps)), lambda y: 2 * y + 1
        >>> for gradient in (by_ad, whole):
        ...     check = sd.check_gradient(gradient, steps, 1.0, 0.5, key=jax.random.key(0))
        ...     print(check.passed)
        False
        True

    Source: own; the second equation is Stochastic Gradient Estimation for Higher-order
    Differentiable Rendering, eq. 17, over antithetic pairs.
    """
    if not 0 < level < 1:
        raise ValueError(f"level={level} must be between 0 and 1, such as 0.05")
    check_whole(num_samples, "num_samples")
    pairs = num_samples // 2
    if num_samples < _FEWEST:
        raise ValueError(f"num_samples={num_samples} are too few: take {_FEWEST} or more")
    y = jax.tree.map(inexact, y)
    params = take_apart(y, sigma, None)
    if params.free:
        raise ValueError("a leaf of y has no sigma: leave out of y what is not checked")
    z = jax.random.normal(as_key(key), (pairs, params.theta.size), params.theta.dtype)
    values, gradients, rounding, usual, constant = _evaluated(grad_fun, fun, params, z)
    u = np.asarray(z, float)
    slopes = _slopes(values, gradients, u)
    sampled = slopes + (values - np.sum(u * slopes, axis=1))[:, None] * u
    off = gradients - sampled
    mean, true = np.mean(off, axis=0), np.mean(sampled, axis=0)
    count, n = off.shape
    stderr = np.std(off, axis=0, ddof=1) / math.sqrt(count)
    # SciPy's special functions take a tenth of a second to import
    from scipy.special import stdtrit

    # rounding may be the same for all pairs, so it does not average out
    half = stdtrit(count - 1, 1 - level / (2 * n)) * stderr + rounding
    wrong = np.abs(mean) > half
    scale = max(np.max(np.abs(true)), np.max(np.abs(np.mean(gradients, axis=0))))
    undecided = ~wrong & (half > max(_ENOUGH * scale, _NEARLY * usual))
    if constant and usual == 0:
        # there is nothing that half could be a share of
        undecided = np.zeros_like(undecided)

    leaves, treedef = jax.tree.flatten(y)
    ends = np.cumsum([leaf.size for leaf in leaves])

    def tree(x: np.ndarray) -> PyTree[np.ndarray]:
        parts = zip(np.split(x, ends[:-1]), leaves, strict=True)
        return treedef.unflatten([part.reshape(leaf.shape) for part, leaf in parts])

    width = np.asarray(params.sigma, float)
    return GradientCheck(
        wrong=tree(wrong),
        undecided=tree(undecided),
        difference=tree(mean / width),
        low=tree((mean - half) / width),
        high=tree((mean + half) / width),
        gradient=tree(true / width),
        level=level,
        evaluations=2 * pairs,
    )


def _slopes(
    values: Float[np.ndarray, " m"],
    gradients: Float[np.ndarray, "m n"],
    u: Float[np.ndarray, "m n"],
) -> Float[np.ndarray, "m n"]:
    """For each pair the slope to take off: of the other half of the pairs, so that it has no bias.

    It is the mean gradient, mended by a linear fit where there are enough pairs: of a gradient that
    is wrong in one entry the others are to be judged by no wider intervals.
    """
    m, n = u.shape
    halves = np.arange(m) < m // 2
    slopes = np.empty_like(u)
    for half in (halves, ~halves):
        slope = np.mean(gradients[half], axis=0)
        if np.sum(half) >= _EACH * n:
            slope = slope + np.linalg.lstsq(u[half], values[half] - u[half] @ slope)[0]
        slopes[~half] = slope
    return slopes


def _evaluated(
    grad_fun: Callable, fun: Callable, params: Params, z: Float[Array, "m n"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m n"], float, float, bool]:
    """Half of the difference of each pair, the mean of both gradients, and what rounding may be.

    And how large the gradient is at a point, in the root of its mean square, the largest entry; and
    whether all values are the same. In units of sigma. One call after the other, outside of any
    transform, so that functions of all kinds will do.
    """
    u = jnp.stack([z, -z], axis=1).reshape(-1, z.shape[1])
    ends = params.theta[None] + params.sigma[None] * u
    points = jax.device_get(jax.vmap(params.layout.tree)(ends))
    values, slopes = [], []
    for i in range(len(ends)):
        y = jax.tree.map(lambda a: jnp.asarray(a[i]), points)  # noqa: B023, used at once
        value, slope = fun(y), grad_fun(y)
        _check(value, slope, y)
        values.append(float(value))
        leaves = [np.ravel(np.asarray(leaf, float)) for leaf in jax.tree.leaves(slope)]
        slopes.append(np.concatenate(leaves))
    pairs = np.reshape(values, (-1, 2))
    width = np.asarray(params.sigma, float)
    each = np.reshape(slopes, (*pairs.shape, -1)) * width
    usual = float(np.max(np.sqrt(np.mean(each**2, axis=(0, 1)))))
    rounding = 8 * float(jnp.finfo(params.theta.dtype).eps) * np.max(np.abs(pairs))
    half = (pairs[:, 0] - pairs[:, 1]) / 2
    return half, each.mean(axis=1), float(rounding), usual, bool(np.ptp(pairs) == 0)


def _check(value: Any, slope: PyTree, y: PyTree[Array]) -> None:
    if np.shape(value) != ():
        raise ValueError(f"fun must return one number, not an array of shape {np.shape(value)}")
    shapes = [jax.tree.map(np.shape, tree) for tree in (slope, y)]
    if jax.tree.structure(slope) != jax.tree.structure(y) or shapes[0] != shapes[1]:
        raise ValueError(
            f"grad_fun returned shapes {shapes[0]} where y has {shapes[1]}: it must return a "
            "pytree like y"
        )
    if not (
        np.isfinite(float(value)) and all(np.all(np.isfinite(s)) for s in jax.tree.leaves(slope))
    ):
        raise ValueError(f"fun or grad_fun is not finite at {y}: make sigma smaller")
