r"""The Gaussian, its derivatives, and the distributions that are proportional to their magnitude.

`order` is 0 for the Gaussian itself, 1 for its first and 2 for its second derivative. With
$t = x / \sigma$,

$$ \mathcal{N} = \frac{e^{-t^2/2}}{\sqrt{2\pi}\,\sigma}, \qquad
   \mathcal{N}' = -\frac{t}{\sigma}\,\mathcal{N}, \qquad
   \mathcal{N}'' = \frac{t^2 - 1}{\sigma^2}\,\mathcal{N}, $$

and the papers sample from $|\mathcal{N}'|$ and $|\mathcal{N}''|$, normalised:
the signed Rayleigh distribution, and one with four humps cut at $\pm\sigma$.

Source: Stochastic Gradient Estimation for Higher-order Differentiable Rendering, eq. 17, 18, 20, 21
(eq. 18 gives NaN as printed, eq. 52 is not a CDF; these are the mended forms).
"""

import math
from functools import lru_cache
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr, ndtri
from jaxtyping import Array, Float

Order = Literal[0, 1, 2]

# in sigmas, where the Gaussian is zero in float64 too
_REACH = 40.0
# the cells of the table of the second-order inverse
_CELLS = 512


def _check(order: int) -> None:
    if order not in (0, 1, 2):
        raise ValueError(f"order must be 0, 1 or 2, not {order!r}")


def derivative(x: Float[Array, "..."], sigma: float | Array = 1.0, order: Order = 0) -> Array:
    r"""The Gaussian or its first or second derivative, signed.

    $$ \mathcal{N}^{(k)}_\sigma(x), \qquad k = 0, 1, 2 $$

    Args:
        x: where, any shape, in the units of sigma.
        sigma: the width.
        order: 0, 1 or 2.

    Returns:
        Values shaped like `x`.

    Raises:
        ValueError: another order.

    Example:
        >>> import jax.numpy as jnp, smoothdiff as sd
        >>> print(f"{sd.kernels.derivative(jnp.array(1.0), 1.0, order=1):.4f}")
        -0.2420

    Source: eq. 17 and 20 (diagonal) of the higher-order rendering paper.
    """
    _check(order)
    t = jnp.clip(x / sigma, -_REACH, _REACH)
    gauss = jnp.exp(-t * t / 2) / (math.sqrt(2 * math.pi) * sigma)
    return (1.0, -t / sigma, (t * t - 1) / sigma**2)[order] * gauss


def log_density(x: Float[Array, "..."], sigma: float | Array = 1.0, order: Order = 0) -> Array:
    r"""The logarithm of the normalised magnitude of the Gaussian's derivative.

    $$ q_0 = \mathcal{N}, \quad q_1 = \frac{|t|}{2\sigma} e^{-t^2/2}, \quad
       q_2 = \frac{|t^2 - 1|}{4\sigma} e^{(1 - t^2)/2} $$

    Args:
        x: where, any shape, in the units of sigma.
        sigma: the width.
        order: 0, 1 or 2.

    Returns:
        Values shaped like `x`; minus infinity where the derivative vanishes.

    Raises:
        ValueError: another order.

    Example:
        >>> import jax.numpy as jnp, smoothdiff as sd
        >>> print(f"{jnp.exp(sd.kernels.log_density(jnp.array(1.0), 1.0, order=1)):.4f}")
        0.3033

    Source: eq. 17 and 21, appendices B and D of the higher-order rendering paper.
    """
    _check(order)
    t = jnp.abs(x / sigma)
    t = jnp.minimum(t, jnp.finfo(t.dtype).max)  # the logarithm of infinity is infinite
    if order == 0:
        return -t * t / 2 - jnp.log(math.sqrt(2 * math.pi) * sigma)
    if order == 1:
        return jnp.log(t) - t * t / 2 - jnp.log(2.0 * sigma)
    return jnp.log(jnp.abs(t - 1)) + jnp.log(t + 1) + (1 - t * t) / 2 - jnp.log(4.0 * sigma)


def cdf(x: Float[Array, "..."], sigma: float | Array = 1.0, order: Order = 0) -> Array:
    r"""The distribution function of `log_density`.

    $$ P_k(x) = \int_{-\infty}^x q_k(t) \, dt $$

    Args:
        x: where, any shape, in the units of sigma.
        sigma: the width.
        order: 0, 1 or 2.

    Returns:
        Probabilities shaped like `x`.

    Raises:
        ValueError: another order.

    Example:
        >>> import jax.numpy as jnp, smoothdiff as sd
        >>> print(f"{sd.kernels.cdf(jnp.array(-1.0), 1.0, order=2):.4f}")
        0.2500

    Source: eq. 21 of the higher-order rendering paper.
    """
    _check(order)
    t = jnp.clip(x / sigma, -_REACH, _REACH)
    if order == 0:
        return ndtr(t)
    if order == 1:
        tail = jnp.exp(-t * t / 2) / 2
        return jnp.where(t <= 0, tail, 1 - tail)
    hump = t / 4 * jnp.exp((1 - t * t) / 2)
    return jnp.where(t < -1, -hump, jnp.where(t > 1, 1 - hump, 0.5 + hump))


def inverse_cdf(u: Float[Array, "..."], sigma: float | Array = 1.0, order: Order = 0) -> Array:
    r"""The inverse of `cdf`, which turns uniform numbers into samples.

    For order 1, $x = \mp\sigma\sqrt{-2 \log 2u'}$ with $u' = \min(u, 1 - u)$. Order 2 has no
    elementary inverse: a table gives the cell, and bisection within the cell the rest.

    Args:
        u: probabilities strictly between 0 and 1, any shape.
        sigma: the width.
        order: 0, 1 or 2.

    Returns:
        Values shaped like `u`, in the units of sigma.

    Raises:
        ValueError: another order.

    Example:
        >>> import jax.numpy as jnp, smoothdiff as sd
        >>> print(f"{sd.kernels.inverse_cdf(jnp.array(0.25), 1.0, order=2):.3f}")
        -1.000

    Source: eq. 18 (mended) and section 3.3 of the higher-order rendering paper.
    """
    _check(order)
    if order == 0:
        return sigma * ndtri(u)
    # both tails from the lower one, where floating point resolves small probabilities
    low = jnp.where(u < 0.5, u, 1 - u)
    t = jnp.sqrt(-2 * jnp.log(2 * low)) if order == 1 else _inverse_second(low)
    return sigma * jnp.where(u < 0.5, -t, t)


@lru_cache(maxsize=1)
def _table() -> tuple[np.ndarray, np.ndarray]:
    """Grid of t = |x| / sigma and the upper tail probability there, falling from 1/2 to 0."""
    inner = np.linspace(0, 1, _CELLS // 4 + 1)
    t = np.concatenate([inner, np.linspace(1, _REACH, 3 * _CELLS // 4 + 1)[1:]])
    hump = t / 4 * np.exp((1 - t * t) / 2)
    return t, np.where(t <= 1, 0.5 - hump, hump)


@jax.custom_jvp  # bisection has no derivative
def _inverse_second(tail: Float[Array, "..."]) -> Array:
    """The t >= 0 whose upper tail probability is `tail` <= 1/2."""
    grid, probability = (jnp.asarray(a, tail.dtype) for a in _table())
    cell = jnp.clip(jnp.searchsorted(-probability, -tail), 1, grid.size - 1)
    low, high = grid[cell - 1], grid[cell]

    def narrow(_: int | Array, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bracket
        middle = (low + high) / 2
        hump = middle / 4 * jnp.exp((1 - middle * middle) / 2)
        above = jnp.where(middle <= 1, 0.5 - hump, hump) > tail
        return jnp.where(above, middle, low), jnp.where(above, high, middle)

    # the density vanishes at t = 1, where Newton's method would leave its cell: bisect instead
    steps = 18 if tail.dtype == jnp.float32 else 47
    low, high = jax.lax.fori_loop(0, steps, narrow, (low, high))
    return (low + high) / 2


@_inverse_second.defjvp
def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    t = _inverse_second(*primals)
    return t, -tangents[0] * jnp.exp(-log_density(t, 1.0, 2))
