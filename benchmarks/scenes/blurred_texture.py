"""A 32 x 32 grey texture, seen through a renderer that blurs it and quantises what it sees.

Each texel influences 5 x 5 pixels. The picture is piecewise constant in the texels.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

PIXELS = 32
RADIUS = 2  # how far a texel reaches, in pixels
LEVELS = 16  # of grey in the picture, from 0 to 1
START = np.full((PIXELS, PIXELS), 0.5)
KERNEL = np.array([1, 4, 6, 4, 1]) / 16
NEAR = np.sum([w * np.eye(PIXELS, k=k - RADIUS) for k, w in enumerate(KERNEL)], axis=0)
BLUR = NEAR / NEAR.sum(axis=1, keepdims=True)  # a line of pixels from a line of texels
Y, X = np.mgrid[0:PIXELS, 0:PIXELS] / PIXELS
REFERENCE = 0.5 + 0.4 * np.sin(2 * np.pi * (X + 2 * Y)) * np.cos(6 * np.pi * (X - 0.5) * Y)


def blurred(texture: Float[Array, "32 32"]) -> Float[Array, "32 32"]:
    """The picture before it is quantised."""
    blur = jnp.asarray(BLUR, texture.dtype)
    rows = jnp.matmul(blur, texture, precision="highest")
    return jnp.matmul(rows, blur.T, precision="highest")


def draw(texture: Float[Array, "32 32"]) -> Float[Array, "32 32"]:
    """The picture."""
    steps = LEVELS - 1
    return jnp.round(jnp.clip(blurred(texture), 0, 1) * steps) / steps


def terms(texture: Float[Array, "32 32"]) -> Float[Array, "32 32"]:
    """Squared differences from the picture of the reference; their sum is the loss."""
    return (draw(texture) - draw(jnp.asarray(REFERENCE, texture.dtype))) ** 2
