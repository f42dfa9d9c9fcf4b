"""What to blame: which terms of an objective each parameter may influence."""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PyTree

from smoothdiff._numbers import floating
from smoothdiff._params import as_first_key, take_apart


class AbstractSupport(eqx.Module):
    """A linear map from parameter-shaped to term-shaped arrays whose matrix has entries 0 and 1."""

    def at(self, params: PyTree) -> "AbstractSupport":
        """The support around these parameters: this one, unless it moves with them."""
        return self

    def __call__(self, params: PyTree) -> Array:
        """For each term, the sum over the parameters that may influence it."""
        raise NotImplementedError


class FunctionSupport(AbstractSupport):
    """A user's own linear function as a support."""

    fun: Callable[[PyTree], Any] = eqx.field(static=True)

    def __call__(self, params: PyTree) -> Array:
        return self.fun(params)


class LocalSupport(AbstractSupport):
    """See `local_support`."""

    radius: int = eqx.field(static=True)
    ndim: int = eqx.field(static=True)

    def __call__(self, params: PyTree) -> Array:
        leaves = jax.tree.leaves(params)
        if len(leaves) != 1 or leaves[0].ndim < self.ndim:
            raise ValueError(
                f"local_support is for one array with at least {self.ndim} axes, not for "
                f"{jax.tree.map(jnp.shape, params)}"
            )
        grid = leaves[0]
        total = jnp.sum(grid, axis=tuple(range(self.ndim, grid.ndim)))
        zero = np.zeros((), total.dtype)
        for axis in range(self.ndim):
            size = [1] * self.ndim
            size[axis] = 2 * self.radius + 1
            total = jax.lax.reduce_window(total, zero, jax.lax.add, size, [1] * self.ndim, "SAME")
        return total


class MatrixSupport(AbstractSupport):
    """See `matrix_support`."""

    terms: Array
    params: Array
    shape: tuple[int, ...] = eqx.field(static=True)
    columns: int = eqx.field(static=True)

    def __call__(self, params: PyTree) -> Array:
        flat = [leaf.reshape(-1) for leaf in jax.tree.leaves(params)]
        vector = flat[0] if len(flat) == 1 else jnp.concatenate(flat)
        if len(vector) != self.columns:
            raise ValueError(
                f"the matrix of the support has {self.columns} columns for {len(vector)} smoothed "
                "parameters: give it one for each"
            )
        sums = jax.ops.segment_sum(vector[self.params], self.terms, math.prod(self.shape))
        return sums.reshape(self.shape)


class MovingSupport(AbstractSupport):
    """See `moving_support`; `where` it is comes from `at`."""

    around: Callable[[PyTree], Callable[[PyTree], Array]] = eqx.field(static=True)
    where: PyTree = None

    def at(self, params: PyTree) -> "MovingSupport":
        return MovingSupport(self.around, params)

    def __call__(self, params: PyTree) -> Array:
        if self.where is None:
            raise ValueError("a moving support is one only somewhere: use support.at(params)")
        support = self.around(self.where)
        if not callable(support):
            raise TypeError(
                "moving_support takes a function that returns a support, such as "
                f"sd.matrix_support(matrix), not {type(support).__name__}"
            )
        return support(params)


def local_support(radius: int, *, ndim: int = 2) -> LocalSupport:
    """The support of a grid of parameters, each of which influences terms up to a radius away.

    $$ S_{pj} = 1 \\text{ if } \\max_a |p_a - j_a| \\le r, \\text{ else } 0 $$

    Costs O(n) and holds no matrix.

    Args:
        radius: how far a parameter reaches, in cells of the grid along each axis.
        ndim: how many leading axes are space; the others, channels, share their cell. The terms
            have the shape of the space axes.

    Returns:
        A callable for the option `support`.

    Raises:
        ValueError: a negative radius; no axis.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> render = lambda texture: jnp.round(texture)
        >>> terms = lambda texture: (render(texture) - 1.0) ** 2
        >>> g = sd.smooth_grad(terms, 0.5, support=sd.local_support(0))
        >>> g(jax.random.key(0), jnp.zeros((4, 4))).shape
        (4, 4)

    Source: own.
    """
    if radius < 0 or ndim < 1:
        raise ValueError(f"radius must be at least 0 and ndim at least 1: {radius}, {ndim}")
    return LocalSupport(radius, ndim)


def matrix_support(matrix: Any, shape: tuple[int, ...] | None = None) -> MatrixSupport:
    """The support that a sparse matrix says.

    Args:
        matrix: a scipy sparse matrix, or a dense array or lists, with a row for each term and a
            column for each smoothed parameter, in the order of `jax.flatten_util.ravel_pytree`; its
            non-zero entries are where a parameter may influence a term.
        shape: the shape of the terms; None for a vector.

    Returns:
        A callable for the option `support`.

    Raises:
        ValueError: a shape that has not one element for each row; when it is called, another number
            of parameters than columns.

    Example:
        >>> import jax, jax.numpy as jnp, numpy as np, smoothdiff as sd
        >>> support = sd.matrix_support(np.eye(3))
        >>> support(jnp.array([1.0, 2.0, 3.0]))
        Array([1., 2., 3.], dtype=float32)

    Source: own.
    """
    matrix = matrix if hasattr(matrix, "nonzero") else np.asarray(matrix)
    shape = (matrix.shape[0],) if shape is None else tuple(shape)
    if math.prod(shape) != matrix.shape[0]:
        raise ValueError(f"{matrix.shape[0]} rows are not terms of shape {shape}")
    terms, params = matrix.nonzero()
    return MatrixSupport(jnp.asarray(terms), jnp.asarray(params), shape, matrix.shape[1])


def moving_support(around: Callable[[PyTree], Callable[[PyTree], Array]]) -> MovingSupport:
    """A support that depends on where the parameters are: that of a body which moves, say.

    $$ S_{pj}(\\theta) = 1 \\text{ if parameter } j \\text{ may influence term } p
       \\text{ near } \\theta, \\text{ else } 0 $$

    Transforms and solvers ask for it at each point where they sample.

    Args:
        around: from the parameters to the support around them, a linear function like any other.
            It is traced, so it may look at their values as JAX functions do.

    Returns:
        For the option `support`. It is no linear function itself: `.at(params)` is.

    Raises:
        TypeError: `around` is no function; when it is called, what it returns is none.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> pixels = jnp.arange(10.0)
        >>> bars = lambda y: jnp.any(jnp.abs(pixels[:, None] - y[None]) < 1, axis=1).astype(float)
        >>> terms = lambda y: (bars(y) - bars(jnp.array([2.0, 7.0]))) ** 2
        >>> near = lambda y: (jnp.abs(pixels[:, None] - y[None]) < 3).astype(float)
        >>> support = sd.moving_support(lambda y: lambda params: near(y) @ params)
        >>> g = sd.smooth_grad(terms, 0.5, support=support)
        >>> print(jnp.sign(g(jax.random.key(0), jnp.array([2.8, 6.3]))))
        [ 1. -1.]

    Source: own.
    """
    if not callable(around):
        raise TypeError(f"around must be a function of the parameters, not {around!r}")
    return MovingSupport(around)


def probe_support(
    fun: Callable[..., Array],
    sigma: PyTree,
    *,
    num_samples: int,
    reach: int,
    response: float = 0.5,
    confidence: float = 0.99,
    atol: float = 0.0,
) -> Callable[..., MatrixSupport]:
    r"""Finds a support by group testing: random subsets of parameters are moved together.

    If parameter j moves term p with probability r at least, then among the M probes that move j
    the term changes in a share of $q = 1 - (1 - b)(1 - r)$ at least, where b is how often it
    changes without j. The parameter is ruled out where the term changed fewer than
    $M q - t_c \sqrt{M q (1 - q)}$ times, $t_c$ the normal quantile of the confidence c. So each
    true influence is missed with probability at most 1 - c, about. What is not ruled out stays in,
    which costs variance and no bias.

    Args:
        fun: returns an array of terms; the first argument holds the parameters.
        sigma: how far to move them, as for `smooth`.
        num_samples: evaluations of `fun`, one of them at the parameters themselves. About 100 for
            each unit of `reach` rule out nearly all that can be ruled out.
        reach: about how many parameters influence one term.
        response: r, how probable it is at least that moving a parameter moves its terms.
        confidence: c.
        atol: a term stands still if it changes by at most this much; above the noise of `fun`.

    Returns:
        `g(key, x, *args)`: a `MatrixSupport` for the option `support`. It runs outside jit.

    Raises:
        ValueError: numbers out of range.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> terms = lambda x: jnp.round(4 * x) ** 2
        >>> probe = sd.probe_support(terms, 1.0, num_samples=100, reach=1)
        >>> support = probe(jax.random.key(0), jnp.zeros(10))
        >>> len(support.params)  # each of ten terms has one parameter
        10

    Source: own; for group testing with random pools see Du and Hwang, Combinatorial Group Testing
    and its Applications (1999).
    """
    if not (0 < response <= 1 and 0 < confidence < 1 and reach >= 1 and atol >= 0):
        raise ValueError(
            "probe_support takes response in (0, 1], confidence in (0, 1), reach >= 1, atol >= 0"
        )
    if num_samples < 2:
        raise ValueError(f"num_samples={num_samples} leaves no probe; about {100 * reach} are good")

    def g(key: Key[Array, ""], x: PyTree, *args: Any) -> MatrixSupport:
        params = take_apart(x, sigma, None)
        n = params.theta.size
        pool, move = jax.random.split(as_first_key(key))
        probes = num_samples - 1
        moved = jax.random.bernoulli(pool, 1 / (2 * reach), (probes, n))
        z = jnp.where(moved, jax.random.normal(move, (probes, n), params.theta.dtype), 0)
        points = params.theta[None] + params.sigma[None] * jnp.concatenate([0 * z[:1], z])
        terms = jax.vmap(lambda t: fun(params.layout.tree(t, params.free), *args))(points)
        terms = floating(terms)
        near = jnp.abs(terms[1:] - terms[:1]) <= atol
        # infinite or NaN in both
        same = (terms[1:] == terms[:1]) | (jnp.isnan(terms[1:]) & jnp.isnan(terms[:1]))
        changed = np.asarray(~(near | same), np.float64)
        changed, with_j = changed.reshape(probes, -1), np.asarray(moved, np.float64)
        together = changed.T @ with_j
        tries = with_j.sum(axis=0)[None]
        without = (changed.sum(axis=0)[:, None] - together) / np.maximum(probes - tries, 1)
        share = 1 - (1 - without) * (1 - response)
        quantile = float(jax.scipy.special.ndtri(confidence))
        least = tries * share - quantile * np.sqrt(tries * share * (1 - share))
        return matrix_support(together >= least, terms.shape[1:])

    return g


def as_support(support: Any) -> AbstractSupport | None:
    """The support itself, or a plain function as one."""
    if support is None or isinstance(support, AbstractSupport):
        return support
    if callable(support) and not isinstance(support, type):
        return FunctionSupport(support)
    raise TypeError(f"support must be a linear function of the parameters, not {support!r}")


def check_support(support: AbstractSupport, like: PyTree, value: PyTree) -> None:
    """Raises ValueError unless the support maps the parameters to the function's terms."""
    out = jax.eval_shape(support, like)
    shapes = [leaf.shape for leaf in jax.tree.leaves(value)]
    if len(shapes) != 1 or shapes[0] != getattr(out, "shape", None):
        raise ValueError(
            f"the support maps the parameters to terms of shape {getattr(out, 'shape', out)}, but "
            f"the function returned {jax.tree.map(jnp.shape, value)}: with a support, return one "
            "array of terms whose sum is the objective, not the sum itself"
        )


def term_weights(
    support: AbstractSupport, tree: Callable[[Array], PyTree], log_w: Float[Array, "m n"]
) -> Array:
    """Weights for each sample and term, from the log weights for each sample and parameter."""
    return jnp.exp(jax.vmap(lambda row: support(tree(row)))(log_w))
