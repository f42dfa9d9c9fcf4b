"""The papers' uniform sampler: points in a box, for comparison."""

import math
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp

from smoothdiff._samplers import PointSampler


class Uniform(PointSampler):
    r"""Points uniform in a box, re-weighted to a normal distribution cut off there.

    $$ z \sim \mathcal{U}[-h, h]^n, \qquad \log w = \log \mathcal{N}(z) + n \log 2h $$

    Biased, as the Gaussian outside of the box is lost, and its weights vary wildly in many
    dimensions. It is here for comparison, as it is in the papers.

    Args:
        half_width: h, in units of sigma.
        antithetic: mirror every point.
        quasi: quasi-random points instead of independent ones.

    Raises:
        ValueError: a half width that is not positive; when points are drawn, an odd `num_samples`
            with `antithetic=True`.

    Example:
        >>> import jax, smoothdiff as sd
        >>> g = sd.smooth_grad(abs, 1.0, sampler=sd.Uniform(), num_samples=64)
        >>> g(jax.random.key(0), 1.0).shape
        ()

    Source: Stochastic Gradient Estimation for Higher-order Differentiable Rendering, appendix J.
    """

    gaussian: ClassVar[bool] = False
    half_width: float = eqx.field(static=True, default=3.0)
    antithetic: bool = eqx.field(static=True, default=False)
    quasi: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        if not 0 < self.half_width < math.inf:
            raise ValueError(f"half_width must be a positive number, not {self.half_width}")

    def scrambled_sets(self) -> int:
        return int(self.quasi)

    def mirrored(self) -> bool:
        return self.antithetic

    def points(self, u, n):
        z = self.half_width * (2 * u - 1)
        constant = n * math.log(2 * self.half_width / math.sqrt(2 * math.pi))
        return z, constant - jnp.sum(z * z, axis=1) / 2
