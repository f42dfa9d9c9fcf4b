"""Where to sample: the points z at which a smoothed function is evaluated, x = theta + sigma z."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key


class AbstractSampler(eqx.Module):
    r"""A distribution of points $z \in \mathbb{R}^n$ that stand for a standard normal vector.

    Points are addressed by row, so that any part of a set can be drawn again without the rest:
    chunks, repeated passes and stored models need no other state than the key.
    """

    @abc.abstractmethod
    def block(self, n: int) -> int:
        """How many consecutive rows are drawn together, in n dimensions."""

    def group(self, num_samples: int, n: int) -> int:
        """How many consecutive rows depend on each other; different groups are independent."""
        return self.block(n)

    @abc.abstractmethod
    def draw(
        self, key: Key[Array, ""], start: int | Array, count: int, num_samples: int, n: int, dtype
    ) -> tuple[Float[Array, "count n"], Float[Array, " count"] | None]:
        """Rows `start` to `start + count` of a set of `num_samples` points.

        Returns:
            The points, and the logarithms of normal density over proposal density; None for the
            latter if the points are normal. `start` and `count` are multiples of `block(n)`.
        """

    def check(self, num_samples: int, n: int) -> None:
        """Raises ValueError if a set of `num_samples` points cannot be drawn."""
        block = self.block(n)
        if num_samples < block or num_samples % block:
            raise ValueError(
                f"{self} draws {block} points at a time: num_samples must be a positive multiple "
                f"of {block}, not {num_samples}"
            )


class Gaussian(AbstractSampler):
    r"""Independent standard normal points, $z \sim \mathcal{N}(0, I)$.

    With `antithetic=True` they come in pairs $z, -z$. A pair cancels what is even in the function
    from its gradient and what is odd from its Hessian, so pairs help the gradient of an odd
    function and value and Hessian hardly at all.

    Args:
        antithetic: draw pairs; `num_samples` counts both partners and must be even.

    Example:
        >>> import jax, smoothdiff as sd
        >>> f = lambda x: (x > 0).astype(float)
        >>> g = sd.smooth_grad(f, 0.5, sampler=sd.Gaussian(antithetic=True), num_samples=4096)
        >>> print(f"{g(jax.random.key(0), 0.0):.1f}")  # the normal density of width 0.5 at 0
        0.8

    Source: Stochastic Gradient Estimation for Higher-order Differentiable Rendering, appendix L
    (every sampler of the paper is antithetic).
    """

    antithetic: bool = eqx.field(static=True, default=False)

    def block(self, n: int) -> int:
        return 2 if self.antithetic else 1

    def draw(self, key, start, count, num_samples, n, dtype):
        block = self.block(n)
        rows = start // block + jnp.arange(count // block)
        keys = jax.vmap(lambda row: jax.random.fold_in(key, row))(rows)
        z = jax.vmap(lambda k: jax.random.normal(k, (n,), dtype))(keys)
        if self.antithetic:
            z = jnp.stack([z, -z], axis=1).reshape(count, n)
        return z, None
