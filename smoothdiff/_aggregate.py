"""The papers' aggregate importance sampler: one set of points for all elements of a derivative."""

import math
from typing import ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from smoothdiff import kernels
from smoothdiff._samplers import PointSampler

# density of the positivised first and second derivative of a normal, over the normal density
_FIRST = math.sqrt(math.pi / 2)
_SECOND = math.sqrt(2 * math.pi * math.e) / 4


class Aggregate(PointSampler):
    r"""Points for all elements of a gradient or Hessian, from the mixture of their best proposals.

    One element is chosen at random, and its dimensions are drawn from the magnitude of the
    Gaussian's derivative, the others from the Gaussian. The density over the normal one is

    $$ \frac{q_1}{p} = \frac1n \sum_i \sqrt{\tfrac{\pi}{2}}\,|z_i|, \qquad
       \frac{q_2}{p} = \frac{1}{n^2} \Big( \sum_i \tfrac{\sqrt{2 \pi e}}{4} |z_i^2 - 1|
       + \sum_{i \ne j} \tfrac{\pi}{2} |z_i z_j| \Big), $$

    A share of the plain Gaussian is mixed in. Without it the weights of the value have infinite
    variance in one dimension, and under order 2 those of the gradient too.

    Args:
        order: 1 for gradients, 2 for Hessians and their products.
        antithetic: mirror every point, as in the paper.
        quasi: quasi-random points instead of independent ones. One set is re-weighted as a whole,
            so baseline="mean" is biased by O(1/N), and "none" is not. The gradient of a step in one
            dimension under order 2 is off by -8 % at N = 8, -2 % at 24 and -0.6 % at 64.
        share: the share of the plain Gaussian; 0 is the sampler as published.

    Raises:
        ValueError: another order, a share that is none; when points are drawn, an odd `num_samples`
            with `antithetic=True`.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> f = lambda x: jnp.floor(jnp.sum(x))
        >>> g = sd.smooth_hessian(f, 1.0, sampler=sd.Aggregate(2), num_samples=64)
        >>> g(jax.random.key(0), jnp.zeros(2)).shape
        (2, 2)

    Source: Stochastic Gradient Estimation for Higher-order Differentiable Rendering, section 3.5.
    """

    gaussian: ClassVar[bool] = False
    order: Literal[1, 2] = eqx.field(static=True)
    antithetic: bool = eqx.field(static=True, default=True)
    quasi: bool = eqx.field(static=True, default=False)
    share: float = eqx.field(static=True, default=0.1)

    def __check_init__(self):
        if self.order not in (1, 2):
            raise ValueError(f"order must be 1 (gradients) or 2 (Hessians), not {self.order!r}")
        if not 0 <= self.share <= 1:
            raise ValueError(f"share must be between 0 and 1, not {self.share}")

    def mirrored(self) -> bool:
        return self.antithetic

    def scrambled_sets(self) -> int:
        return int(self.quasi)

    def uniforms(self, n: int) -> int:
        # each dimension of the element takes one, and so does whether to be a plain Gaussian
        return n + 1 + self.order

    def points(self, u, n):
        special = (u[:, n] >= self.share)[:, None]
        element = jnp.minimum((u[:, n + 1 :] * n).astype(jnp.int32), n - 1)
        u = u[:, :n]
        dims = jnp.arange(n, dtype=element.dtype)[None]
        normal, first = kernels.inverse_cdf(u, 1.0, 0), kernels.inverse_cdf(u, 1.0, 1)
        if self.order == 1:
            z = jnp.where(special & (dims == element), first, normal)
            return z, self.log_ratio(z)
        i, j = element[:, :1], element[:, 1:]
        z = jnp.where(special & ((dims == i) | (dims == j)), first, normal)
        # the inverse of order 2 is the dear one, and one number of each row needs it
        own = kernels.inverse_cdf(jnp.take_along_axis(u, i, axis=1), 1.0, 2)
        z = jnp.where(special & (i == j) & (dims == i), own, z)
        return z, self.log_ratio(z)

    def log_ratio(self, z: Float[Array, "m n"]) -> Float[Array, " m"]:
        """The logarithm of normal density over the density of this sampler."""
        n = z.shape[1]
        first = _FIRST * jnp.abs(z)
        if self.order == 1:
            mixture = jnp.mean(first, axis=1)
        else:
            second = _SECOND * jnp.abs(jnp.abs(z) - 1) * (jnp.abs(z) + 1)
            pairs = jnp.sum(first, axis=1) ** 2 - jnp.sum(first * first, axis=1)
            mixture = (jnp.sum(second, axis=1) + pairs) / float(n**2)
        return -jnp.log((1 - self.share) * mixture + self.share)
