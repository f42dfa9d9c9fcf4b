r"""Gauss-Newton steps of many places at once, where it is known which terms a parameter moves.

Samples see all parameters move at the same time. Around a term t few of them matter, so a batch
that is small beside all parameters is large there. With centred samples u and residuals r, the step
in the space of M samples, around one term, is that of Levenberg and Marquardt,

$$ w_t = -(G_t + \lambda \tau_t I)^{-1} g_t, \qquad
   G_t = \sum_s N_{ts} R_s R_s^T, \quad g_t = \sum_s N_{ts} R_s m_s, $$

with $R_s$ (M rows) the residuals of the term s, m their mean, $\tau$ the mean of the diagonal, and
$N = S S^T$ the number of parameters that two terms share, S being the support: nearby terms have
more say than those further off. A parameter takes the mean of the steps of its own terms,

$$ \Delta_j = \sum_t S_{tj} \, (w_t \cdot u_j) / \sum_t S_{tj}. $$

So nothing larger than M x M is solved, once for all dampings (by a tridiagonalisation, which JAX
has for CPUs and GPUs), and steps change as smoothly from place to place as supports overlap. To
solve once for each parameter instead, by its own terms alone, converges more slowly where supports
overlap, and takes longer.

Source: own; ensemble Kalman filters are localised like this (Hunt, Kostelich and Szunyogh, 2007),
and so are their weights averaged (Yang, Kalnay, Hunt and Bowler, 2009).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from smoothdiff._products import dot
from smoothdiff._support import AbstractSupport

# of each step, in units of the mean diagonal
DAMPINGS = (30.0, 10.0, 3.0, 1.0, 0.3, 0.1, 0.03, 0.01)
# so many pairs of samples, and so many terms, at a time: a matter of memory
_PAIRS, _TERMS = 64, 256


class Blame(NamedTuple):
    """A support as a map between vectors.

    Attributes:
        terms: For each term, the sum over the parameters that may influence it.
        params: For each parameter, the sum over the terms that it may influence.
    """

    terms: Callable[[Float[Array, " n"]], Float[Array, " T"]]
    params: Callable[[Float[Array, " T"]], Float[Array, " n"]]

    @staticmethod
    def of(
        support: AbstractSupport, tree: Callable[[Array], PyTree], theta: Float[Array, " n"]
    ) -> "Blame":
        """That of a support around the parameters, which `tree` makes of a vector."""
        support = support.at(tree(theta))
        # what depends on where the support is is computed here, and once
        _, terms = jax.linearize(lambda x: support(tree(x)).ravel(), theta)
        transposed = jax.linear_transpose(terms, theta)
        return Blame(terms, lambda x: transposed(x)[0])


def ensemble_steps(
    blame: Blame,
    u: Float[Array, "M n"],
    residuals: Float[Array, "M T q"],
    mean: Float[Array, "T q"],
) -> Float[Array, "dampings n"]:
    """The steps that lower the mean residuals, from the most to the least damped.

    Args:
        blame: Which terms a parameter may influence.
        u: Samples of the parameters, centred; zeros where one does not count.
        residuals: Those of each term there, centred likewise.
        mean: What was subtracted from the residuals.
    """
    count = len(u)
    left, right = np.triu_indices(count)
    place = np.zeros((count, count), np.int32)
    place[left, right] = place[right, left] = np.arange(len(left))
    neighbours = _neighbours(blame, len(mean), len(left), u.dtype)

    def gram(pair: tuple[Array, Array]) -> Array:
        return neighbours(jnp.sum(residuals[pair[0]] * residuals[pair[1]], axis=1))

    def side(row: Array) -> Array:
        return neighbours(jnp.sum(row * mean, axis=1))

    grams = jax.lax.map(gram, (left, right), batch_size=_PAIRS)
    sides = jax.lax.map(side, residuals, batch_size=_PAIRS)

    def weights(term: tuple[Array, Array]) -> Array:
        entries, side = term
        matrix = entries[place]
        level = jnp.trace(matrix) / count
        damping = jnp.asarray(DAMPINGS, u.dtype) * jnp.where(level > 0, level, 1)
        return _solve_damped(matrix, side, damping)

    found = jax.lax.map(weights, (grams.T, sides.T), batch_size=_TERMS)

    def add(total: Array, sample: tuple[Array, Array]) -> tuple[Array, None]:
        weight, one = sample
        return total + jax.vmap(blame.params)(weight) * one[None], None

    total = jnp.zeros((len(DAMPINGS), u.shape[1]), u.dtype)
    total, _ = jax.lax.scan(add, total, (jnp.transpose(found, (2, 1, 0)), u))
    return -total / jnp.maximum(blame.params(jnp.ones_like(mean[:, 0])), 1)[None]


def _neighbours(
    blame: Blame, terms: int, uses: int, dtype: jnp.dtype
) -> Callable[[Float[Array, " T"]], Float[Array, " T"]]:
    """The product with N, which is written down if it is used more often than it has columns."""
    product = lambda term: blame.terms(blame.params(term))
    if terms >= uses:
        return product
    shared = jax.lax.map(product, jnp.eye(terms, dtype=dtype), batch_size=_PAIRS)
    return lambda term: dot(shared, term)


def _solve_damped(
    matrix: Float[Array, "M M"], side: Float[Array, " M"], damping: Float[Array, " k"]
) -> Float[Array, "k M"]:
    """The solutions of (matrix + damping I) x = side, from one tridiagonalisation."""
    packed, diagonal, beside, taus = jax.lax.linalg.tridiagonal(matrix, lower=True)
    turn = jax.lax.linalg.householder_product(packed[1:, :-1], taus)
    turned = jnp.concatenate([side[:1], dot(side[1:], turn)])[:, None]
    below, above = jnp.pad(beside, (1, 0)), jnp.pad(beside, (0, 1))
    solve = lambda d: jax.lax.linalg.tridiagonal_solve(below, diagonal + d, above, turned)[:, 0]
    found = jax.vmap(solve)(damping)
    return jnp.concatenate([found[:, :1], dot(found[:, 1:], turn.T)], axis=1)


def best_of_each_place(
    blame: Blame, ends: Float[Array, "K n"], losses: Float[Array, "K T"]
) -> Float[Array, " n"]:
    """Each parameter from the end that is best in the terms that it may influence."""
    worst = jnp.max(jnp.where(jnp.isfinite(losses), losses, 0))
    losses = jnp.where(jnp.isfinite(losses), losses, 2 * worst + 1)
    chosen = jnp.argmin(jax.vmap(blame.params)(losses), axis=0)
    return jnp.take_along_axis(ends, chosen[None], axis=0)[0]
