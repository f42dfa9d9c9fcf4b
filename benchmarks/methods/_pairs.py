"""The sampled slopes of Fischer and of Wang and their co-authors, as their published code has them.

All samples are antithetic pairs, and nothing is subtracted. Each function returns
`slope(key, sigma, x) -> vector` of the smoothed loss; with n parameters it makes this many
evaluations of the loss:

- `fischer`: 2 pairs. Every parameter is drawn from its own positivised kernel at once, so what is
  smoothed is, for each derivative, another function (FR22).
- `by_element`: 2 pairs n. Each derivative has pairs of its own (Wang et al., eq. 17 and 18).
- `aggregate`: 2 pairs. Pairs are dealt over the parameters (section 3.5): a derivative is estimated
  by the pairs that were dealt to it, and if it got none by the others'.

    M. Fischer, T. Ritschel: Plateau-reduced Differentiable Path Tracing. CVPR (2023).
    Z. Wang, M. Fischer, T. Ritschel: Stochastic Gradient Estimation for Higher-order Differentiable
    Rendering (2024).
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import smoothdiff as sd
from benchmarks._task import Key
from benchmarks.methods._flat import Flat

Slope = Callable[[Key, jax.Array, jax.Array], jax.Array]
# of a positivised kernel z N(z): its density is sqrt(2 / pi) times it
POSITIVE = float(np.sqrt(2 / np.pi))


def fischer(flat: Flat, pairs: int) -> Slope:
    """All parameters at once, each weighted by the sign of its own offset."""

    def slope(key, sigma, x):
        z = _positivised(key, (pairs, flat.size), x.dtype)
        return POSITIVE / sigma * jnp.mean(_halves(flat, sigma, x, z)[:, None] * jnp.sign(z), 0)

    return slope


def by_element(flat: Flat, pairs: int) -> Slope:
    """Pairs of its own for each derivative."""
    gradient = sd.Importance(1)
    options = {"num_samples": 2 * pairs, "baseline": "none"}
    return lambda key, sigma, x: gradient(flat.loss, sigma, **options)(key, x)


def aggregate(flat: Flat, pairs: int) -> Slope:
    """One batch for all derivatives, with as equal a share of it for each as there can be."""
    n = flat.size

    def slope(key, sigma, x):
        deal, own, rest = jax.random.split(key, 3)
        chosen = jax.random.permutation(deal, n)[jnp.arange(pairs) % n]
        to = jax.nn.one_hot(chosen, n, dtype=x.dtype)  # pairs x parameters
        special = _positivised(own, (pairs, 1), x.dtype)
        z = jnp.where(to > 0, special, jax.random.normal(rest, (pairs, n), x.dtype))
        halves = _halves(flat, sigma, x, z)[:, None]
        each = POSITIVE / sigma * halves * z / jnp.abs(special)
        shares = jnp.sum(to, 0)
        mine = jnp.sum(to * each, 0) / jnp.maximum(shares, 1)
        # the mean of the parameters' estimates, where those without pairs count as zero
        others = jnp.sum(each / shares[chosen][:, None], 0) / n
        return jnp.where(shares > 0, mine, others)

    return slope


def _positivised(key: Key, shape: tuple[int, ...], dtype: Any) -> jax.Array:
    """Offsets whose density is that of the positivised kernel, of width 1 (eq. 18, mended)."""
    side, far = jax.random.split(key)
    return jax.random.rademacher(side, shape, dtype) * jnp.maximum(
        jax.random.rayleigh(far, 1.0, shape, dtype), jnp.finfo(dtype).tiny
    )


def _halves(flat: Flat, sigma: jax.Array, x: jax.Array, z: jax.Array) -> jax.Array:
    """Half the difference between the two ends of each pair."""
    points = jnp.concatenate([x[None] + sigma * z, x[None] - sigma * z])
    ahead, behind = jnp.split(jax.vmap(flat.loss)(points), 2)
    return (ahead - behind) / 2
