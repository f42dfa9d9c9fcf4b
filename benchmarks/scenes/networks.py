"""Small fully connected networks as black boxes: weights and biases, layer by layer."""

import itertools
from collections.abc import Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Layers: TypeAlias = list[tuple[Array, Array]]


def initial(sizes: Sequence[int], key: Array) -> Layers:
    """As PyTorch does it: uniform in plus and minus the root of one over a layer's inputs."""
    layers = []
    for inputs, outputs in itertools.pairwise(sizes):
        key, *keys = jax.random.split(key, 3)
        k = inputs**-0.5
        weights, bias = (
            jax.random.uniform(key, shape, minval=-k, maxval=k)
            for key, shape in zip(keys, ((outputs, inputs), (outputs,)), strict=True)
        )
        layers.append((weights, bias))
    return layers


def hidden(layers: Layers, x: Float[Array, " inputs"]) -> Float[Array, " width"]:
    """What the last layer sees: all layers before it, with ReLU."""
    for weights, bias in layers[:-1]:
        x = jax.nn.relu(weights @ x + bias)
    return x


def apply(layers: Layers, x: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
    """The network; its last layer is linear."""
    weights, bias = layers[-1]
    return weights @ hidden(layers, x) + bias


def last_layer(
    features: Float[Array, "cases width"],
    outputs: Float[Any, "cases outputs"],
    cutoff: float | None = None,
) -> tuple[Float[Array, "outputs width"], Float[Array, " outputs"]]:
    """Weights and bias of a linear layer that gives the outputs, by least squares.

    Args:
        features: What the layer sees.
        outputs: What it is to say.
        cutoff: Singular values below this share of the largest count as zero.
    """
    with_ones = np.pad(np.asarray(features, float), ((0, 0), (0, 1)), constant_values=1)
    found = np.linalg.lstsq(with_ones, np.asarray(outputs, float), cutoff)[0]
    weights, bias = np.split(found.T, [-1], axis=1)
    return jnp.asarray(weights, jnp.float32), jnp.asarray(bias[:, 0], jnp.float32)
