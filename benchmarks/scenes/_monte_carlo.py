"""What pictures by Monte Carlo share: the mean of samples, the loss, and its unbiased gradient."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def mean_of(sample: Callable[[Any], Array], inputs: Array) -> Array:
    """The mean of the samples of all inputs, which are drawn one after the other."""
    zero = jnp.zeros_like(jax.eval_shape(sample, inputs[0]))
    add = lambda image, one: (image + sample(one), None)
    return jax.lax.scan(add, zero, inputs)[0] / len(inputs)


def loss(image: Float[Array, "..."], reference: Float[Array, "..."]) -> Float[Array, ""]:
    """The squared error of a picture, the mean over the channels and the sum over the pixels."""
    return jnp.sum((image - reference) ** 2) / 3


def gradient(sample: Callable[[Any], Array], y: Any, seen: Array, reference: Array) -> Any:
    """That of `loss`, unbiased, as `sample` has samples of its own, not those of what is `seen`."""
    return jax.vjp(sample, y)[1](2 * (seen - reference) / 3)[0]
