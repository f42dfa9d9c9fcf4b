"""MLP: the 35,152 weights of a network that draws one digit, 256 -> 32 -> 32 -> 784.

ReLU in the hidden layers and a sigmoid at the end; the input is one fixed vector. Sigma is that of
ZeroGrads (supplement, Table 1). The reference is one of many networks that draw the digit.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks import methods
from benchmarks._task import Task
from benchmarks.scenes import digits, networks

TITLE = "MLP: 35,152 weights of a network that draws a digit"
METHODS = methods.MANY_PARAMETERS
LAYERS = (256, 32, 32, 784)
DIGIT = 3
CONTRAST = 0.96  # of the digit: a sigmoid reaches neither 0 nor 1
INPUT = np.random.default_rng(0).uniform(-1, 1, LAYERS[0])
SIGMA = 0.025


def draw(layers: networks.Layers) -> Float[Array, "784"]:
    """What a network draws."""
    return jax.nn.sigmoid(networks.apply(layers, jnp.asarray(INPUT, layers[0][0].dtype)))


def build(full: bool) -> Task:
    """Starts are networks as they are before training."""
    images, which = digits.load()
    digit = digits.enlarged(images[np.flatnonzero(which == DIGIT)[0]]).ravel()
    target = 0.5 + CONTRAST * (digit - 0.5)
    # all is in the last bias
    drawing = jax.tree.map(jnp.zeros_like, networks.initial(LAYERS, jax.random.key(0)))
    drawing[-1] = drawing[-1][0], jnp.asarray(np.log(target / (1 - target)), jnp.float32)

    def image(layers: networks.Layers) -> Float[Array, "28 28 3"]:
        grey = draw(layers).reshape(digits.PIXELS, digits.PIXELS, 1)
        return jnp.repeat(grey, 3, axis=-1)

    return networks.weights_task(
        full,
        "mlp",
        TITLE,
        draw,
        jnp.asarray(target, jnp.float32),
        drawing,
        image,
        SIGMA,
        "Many networks draw the digit: the parameter error says nothing.",
    )
