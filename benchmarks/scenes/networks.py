"""Small fully connected networks as black boxes: weights and biases, layer by layer."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from benchmarks._task import Budget, Task

Layers: TypeAlias = list[tuple[Array, Array]]
BOUND = 5.0


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


def weights_task(
    full: bool,
    name: str,
    title: str,
    draw: Callable[[Layers], Float[Array, "..."]],
    target: Float[Array, "..."],
    solved: Layers,
    image: Callable[[Layers], Float[Array, "height width 3"]],
    sigma: float,
    notes: str,
) -> Task:
    """The task of finding the weights of a network, from networks as they are before training.

    Args:
        full: As for all tasks.
        name: Of the task.
        title: What is sought.
        draw: What is drawn with a network.
        target: What is to be drawn. The loss is the mean squared difference.
        solved: A network that draws it, one of many.
        image: As `draw`, to look at.
        sigma: The scale of the weights.
        notes: Beside the results.
    """
    reference, layers = ravel_pytree(solved)
    sizes = [solved[0][0].shape[1], *(bias.size for _, bias in solved)]

    def residuals(y: Float[Array, " weights"]) -> Float[Array, "..."]:
        return draw(layers(y)) - target

    def loss(y: Float[Array, " weights"]) -> Float[Array, ""]:
        return jnp.mean(residuals(y) ** 2)

    return Task(
        name=name,
        title=title,
        loss=loss,
        exact_loss=loss,
        start=lambda seed: ravel_pytree(initial(sizes, jax.random.key(seed)))[0],
        reference=reference,
        bounds=(jnp.full_like(reference, -BOUND), jnp.full_like(reference, BOUND)),
        sigma=sigma,
        budget=Budget(100_000, 1200) if full else Budget(4000, 120),
        seeds=10 if full else 1,
        image=lambda y: image(layers(y)),
        residuals=residuals,
        notes=notes,
    )
