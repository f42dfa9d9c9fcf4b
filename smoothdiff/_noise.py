"""What smooths in place of the Gaussian, and who draws the points of a call."""

from typing import Any, ClassVar, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from smoothdiff._samplers import AbstractSampler, Sobol


@runtime_checkable
class Noise(Protocol):
    r"""Another distribution as the smoothing kernel itself, in place of the Gaussian.

    $$ F(\theta) = \mathbb{E}_{z \sim p}[f(\theta + \sigma z)], \qquad
       \log w = \log p\big(\tfrac{x - \theta}{\sigma}\big) - \log p(z) $$

    Any object with these two methods is one, among them the distributions of
    `optax.perturbations`. Derivatives are as good as `log_prob` is smooth. An object that is in use
    must not change: JAX keeps what was compiled with its first values. For others make another one.

    Raises:
        TypeError: from the transforms, for a `noise` that lacks one of these methods.

    Example:
        >>> import jax, jax.numpy as jnp, optax, smoothdiff as sd
        >>> gumbel = optax.perturbations.Gumbel()
        >>> one_hot = lambda x: (x == jnp.max(x)).astype(float)
        >>> soft = sd.smooth(one_hot, 1.0, noise=gumbel, num_samples=4096)
        >>> print(soft(jax.random.key(0), jnp.zeros(2)).round(1))  # a softmax
        [0.5 0.5]

    Source: Q. Berthet et al., Learning with differentiable perturbed optimizers (2020).
    """

    def sample(self, key: Any, sample_shape: Any, dtype: Any, /) -> Array:
        """Independent samples of this shape."""
        ...

    def log_prob(self, z: Any, /) -> Array:
        """The logarithm of the density, elementwise; differentiable, up to a constant."""
        ...


class NoiseSampler(AbstractSampler):
    """Points from the smoothing kernel itself, which is no Gaussian."""

    gaussian: ClassVar[bool] = False
    noise: Noise = eqx.field(static=True)

    def block(self, num_samples: int, n: int) -> int:
        return 1

    def draw(self, key, start, count, num_samples, n, dtype):
        keys = jax.vmap(lambda row: jax.random.fold_in(key, row))(start + jnp.arange(count))
        z = jax.vmap(lambda k: self.noise.sample(k, (n,), dtype))(keys)
        # the kernel's density over that of the points
        return z, jnp.zeros(count, dtype)

    def log_prob(self, z: Float[Array, "... n"]) -> Float[Array, "..."]:
        """The logarithm of the density of whole points."""
        return jnp.sum(self.noise.log_prob(z), axis=-1)


def as_sampler(sampler: Any, noise: Any = None) -> AbstractSampler:
    """Who draws the points: the sampler, the noise, or Sobol's sequence if there is neither."""
    if noise is not None and not _is_noise(noise):
        raise TypeError(
            "noise must be an object with sample and log_prob, such as "
            f"optax.perturbations.Gumbel(), not {noise!r}; where to sample is sampler=..."
        )
    if sampler is None:
        return Sobol() if noise is None else NoiseSampler(noise)
    if not isinstance(sampler, AbstractSampler):
        if _is_noise(sampler):
            raise TypeError(
                f"{sampler!r} is what smooths, not where to sample: write noise=... instead of "
                "sampler=..."
            )
        raise TypeError(
            "sampler must be a sampler object such as Gaussian() or Sobol(), an instance of "
            f"AbstractSampler, not {sampler!r} (of the papers' estimators by element write "
            "Importance(1)(fun, sigma, ...))"
        )
    if noise is not None:
        raise ValueError(
            f"noise={noise!r} draws its points itself: leave out the sampler, or smooth with the "
            "Gaussian, without noise"
        )
    return sampler


def _is_noise(thing: Any) -> bool:
    return isinstance(thing, Noise) and not isinstance(thing, AbstractSampler | type)
