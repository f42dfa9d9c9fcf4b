"""Where to sample: the points z at which a smoothed function is evaluated, x = theta + sigma z."""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from smoothdiff._numbers import check_whole
from smoothdiff._uniform import midpoints, uniform_bits


class AbstractSampler(eqx.Module):
    r"""A distribution of points $z \in \mathbb{R}^n$ that stand for a standard normal vector.

    Points are addressed by row, so that any part of a set can be drawn again without the rest:
    chunks, repeated passes and stored models need no other state than the key.

    Every sampler says in `gaussian` whether its points are standard normal as they are drawn. If
    not, `draw` returns their weights, and if so it returns None for them.

    Raises:
        TypeError: a subclass that does not say `gaussian`.

    Example:
        >>> from typing import ClassVar
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> class Plain(sd.AbstractSampler):
        ...     gaussian: ClassVar[bool] = True
        ...     def block(self, num_samples, n):
        ...         return 1
        ...     def draw(self, key, start, count, num_samples, n, dtype):
        ...         rows = start + jnp.arange(count)
        ...         one = lambda row: jax.random.normal(jax.random.fold_in(key, row), (n,), dtype)
        ...         return jax.vmap(one)(rows), None
        >>> g = sd.smooth_grad(jnp.sum, 0.5, sampler=Plain(), baseline="linear", num_samples=64)
        >>> print(g(jax.random.key(0), jnp.ones(2)).round(3))
        [1. 1.]

    Source: own.
    """

    gaussian: ClassVar[bool]

    def __check_init__(self):
        if not isinstance(getattr(self, "gaussian", None), bool):
            raise TypeError(
                f"{type(self).__name__} does not say whether its points are standard normal: write "
                "`gaussian: ClassVar[bool] = True` in the class, or False if `draw` returns the "
                "logarithms of normal density over that of the points"
            )

    @property
    def balanced(self) -> bool:
        """Whether a set is even as a whole, so that baselines are best fitted to all of it."""
        return False

    @abc.abstractmethod
    def block(self, num_samples: int, n: int) -> int:
        """How many consecutive rows of a set are drawn together, in n dimensions."""

    def group(self, num_samples: int, n: int) -> int:
        """How many consecutive rows depend on each other; different groups are independent."""
        return self.block(num_samples, n)

    @abc.abstractmethod
    def draw(
        self, key: Key[Array, ""], start: int | Array, count: int, num_samples: int, n: int, dtype
    ) -> tuple[Float[Array, "count n"], Float[Array, " count"] | None]:
        """Rows `start` to `start + count` of a set of `num_samples` points.

        Returns:
            The points, and the logarithms of normal density over proposal density; None for the
            latter if `gaussian`. `start` and `count` are multiples of the block. Traced
            by JAX, always: no value can be looked at.
        """

    def check(self, num_samples: int, n: int) -> None:
        """Raises ValueError if a set of `num_samples` points cannot be drawn."""
        block = self.block(num_samples, n)
        if num_samples < block or num_samples % block:
            raise ValueError(
                f"{self} draws {block} points at a time: num_samples must be a positive multiple "
                f"of {block}, not {num_samples}"
            )


class PointSampler(AbstractSampler):
    """A sampler that turns uniform numbers into points, one row into one point.

    Every point may come with its mirror image; `num_samples` counts both.
    """

    @abc.abstractmethod
    def mirrored(self) -> bool:
        """Whether points come in pairs z, -z."""

    def scrambled_sets(self) -> int:
        """How many scrambled Sobol sequences the uniform numbers are; 0: they are independent."""
        return 0

    @property
    def balanced(self) -> bool:
        return self.scrambled_sets() > 0

    def block(self, num_samples: int, n: int) -> int:
        return 2 if self.mirrored() else 1

    def group(self, num_samples: int, n: int) -> int:
        sets = self.scrambled_sets()
        return num_samples // sets if sets else self.block(num_samples, n)

    def check(self, num_samples: int, n: int) -> None:
        super().check(num_samples, n)
        parts = self.scrambled_sets() * self.block(num_samples, n)
        if parts and num_samples % parts:
            raise ValueError(
                f"num_samples={num_samples} must be a multiple of {parts} for {self}: "
                "every replicate has as many points"
            )

    def uniforms(self, n: int) -> int:
        """How many uniform numbers one point takes."""
        return n

    @abc.abstractmethod
    def points(
        self, u: Float[Array, "m k"], n: int
    ) -> tuple[Float[Array, "m n"], Float[Array, " m"] | None]:
        """Points, and log ratios as in `draw`, from uniform numbers."""

    def draw(self, key, start, count, num_samples, n, dtype):
        block = self.block(num_samples, n)
        rows = start // block + jnp.arange(count // block)
        size = self.group(num_samples, n) // block if self.balanced else None
        bits = uniform_bits(key, rows, self.uniforms(n), size)
        z, log_ratio = self.points(midpoints(bits, dtype), n)
        if self.mirrored():
            z = jnp.stack([z, -z], axis=1).reshape(count, n)
            log_ratio = None if log_ratio is None else jnp.repeat(log_ratio, 2)
        return z, log_ratio


class Gaussian(PointSampler):
    r"""Independent standard normal points, $z \sim \mathcal{N}(0, I)$.

    With `antithetic=True` they come in pairs $z, -z$. A pair cancels what is even in the function
    from its gradient and what is odd from its Hessian, so pairs help the gradient of an odd
    function and the Hessian hardly at all.

    Args:
        antithetic: draw pairs; `num_samples` counts both partners and must be even.

    Raises:
        ValueError: when points are drawn, an odd `num_samples` with `antithetic=True`.

    Example:
        >>> import jax, smoothdiff as sd
        >>> f = lambda x: (x > 0).astype(float)
        >>> g = sd.smooth_grad(f, 0.5, sampler=sd.Gaussian(antithetic=True), num_samples=4096)
        >>> print(f"{g(jax.random.key(0), 0.0):.1f}")  # the normal density of width 0.5 at 0
        0.8

    Source: Stochastic Gradient Estimation for Higher-order Differentiable Rendering, appendix L
    (every sampler of the paper is antithetic).
    """

    gaussian: ClassVar[bool] = True
    antithetic: bool = eqx.field(static=True, default=False)

    def mirrored(self) -> bool:
        return self.antithetic

    def points(self, u, n):
        return jax.scipy.special.ndtri(u), None


class Sobol(PointSampler):
    r"""Scrambled Sobol points, mapped to normal ones by the inverse normal CDF.

    $$ z = \Phi^{-1}\big((\lfloor 2^{23} u \rfloor + \tfrac12) / 2^{23}\big) $$

    The points fill the space evenly, so errors fall faster than $N^{-1/2}$ where the function, or
    its main part, depends on few parameters at a time. Each key scrambles the points anew, which
    keeps every single point exactly normal. Any number of points works; powers of two are the most
    even. Beyond 21,201 parameters, where no Sobol sequence is tabulated, the others get
    independent random numbers.

    Args:
        antithetic: mirror every point. Scrambled points are better without.
        replicates: how many independently scrambled sets there are, of `num_samples / replicates`
            points each. With one, the default, standard errors are an upper bound. Eight sets make
            them honest, at 1.3 times the error with "gp" and 1.9 times with "mean" (N = 256, ten
            dimensions): 96 and 94 % of the 95 % intervals by Student's t, with 7 degrees of
            freedom, hold the true gradient. With four sets 97 and 96 % do, at 1.3 and 1.4 times the
            error.

    Raises:
        ValueError: fewer than one replicate; when points are drawn, a `num_samples` that is no
            multiple of `replicates`, or of twice that with `antithetic=True`.

    Example:
        >>> import jax, smoothdiff as sd
        >>> f = lambda x: (x > 0).astype(float)
        >>> g = sd.smooth_grad(f, 0.5, sampler=sd.Sobol(), num_samples=256)
        >>> print(f"{g(jax.random.key(0), 0.0):.2f}")  # the normal density of width 0.5 at 0
        0.80

    Source: A. B. Owen, Randomly permuted (t,m,s)-nets and (t,s)-sequences (1995). The rendering
    papers use independent points.
    """

    gaussian: ClassVar[bool] = True
    antithetic: bool = eqx.field(static=True, default=False)
    replicates: int = eqx.field(static=True, default=1)

    def __check_init__(self):
        check_whole(self.replicates, "replicates")
        if self.replicates < 1:
            raise ValueError(f"replicates must be at least 1, not {self.replicates}")

    def scrambled_sets(self) -> int:
        return self.replicates

    def mirrored(self) -> bool:
        return self.antithetic

    def points(self, u, n):
        return jax.scipy.special.ndtri(u), None


class Orthogonal(AbstractSampler):
    r"""Random orthogonal frames with chi-distributed radii.

    $$ z_i = r_i\, q_i, \quad (q_1, \ldots, q_b) \text{ Haar-distributed}, \quad r_i \sim \chi_n $$

    Each point is exactly normal, and the b points of a frame look in perpendicular directions, so
    that n samples explore n directions where independent ones would repeat some.

    Args:
        antithetic: mirror every point. A frame then has 2n points, else n; with fewer samples than
            that there is one partial frame.

    Raises:
        ValueError: when points are drawn, an odd `num_samples` with `antithetic=True`, or one that
            is larger than a frame and no multiple of it.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> f = lambda x: jnp.sum(x)
        >>> g = sd.smooth_grad(f, 1.0, sampler=sd.Orthogonal(), num_samples=40)
        >>> g(jax.random.key(0), jnp.zeros(10)).shape
        (10,)

    Source: K. Choromanski et al., Structured evolution with compact architectures for scalable
    policy optimization (2018).
    """

    gaussian: ClassVar[bool] = True
    antithetic: bool = eqx.field(static=True, default=True)

    def block(self, num_samples: int, n: int) -> int:
        return min(num_samples, 2 * n if self.antithetic else n)

    def draw(self, key, start, count, num_samples, n, dtype):
        block = self.block(num_samples, n)
        size = block // 2 if self.antithetic else block
        frames = start // block + jnp.arange(count // block)

        def frame(index: Array) -> Array:
            directions, lengths = jax.random.split(jax.random.fold_in(key, index))
            q, r = jnp.linalg.qr(jax.random.normal(directions, (n, size), dtype))
            q = q * jnp.sign(jnp.diagonal(r))[None]  # without this Q is not uniform
            radius = jnp.sqrt(2 * jax.random.gamma(lengths, n / 2, (size,), dtype))
            return (q * radius[None]).T

        # one frame after the other: a batched QR gains nothing on a CPU and costs memory
        z = jax.lax.map(frame, frames)
        if self.antithetic:
            z = jnp.stack([z, -z], axis=2)
        return z.reshape(count, n), None

    def check(self, num_samples: int, n: int) -> None:
        if self.antithetic and num_samples % 2:
            raise ValueError(f"{self} draws pairs: num_samples must be even, not {num_samples}")
        super().check(num_samples, n)
