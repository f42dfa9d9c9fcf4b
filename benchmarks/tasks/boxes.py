"""Hard-edged coloured squares that add up: Box10, five squares whose positions are sought.

The loss is piecewise constant, so its derivative is zero wherever it exists.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

PIXELS = 64
SIDE = 13  # of a square, in pixels
COLOURS = ((0.9, 0.1, 0.1), (0.1, 0.8, 0.1), (0.1, 0.2, 0.9), (0.8, 0.7, 0.1), (0.6, 0.1, 0.7))
BOX10_START = (0.46, 0.46, 0.54, 0.46, 0.5, 0.5, 0.46, 0.54, 0.54, 0.54)  # huddled
BOX10_REFERENCE = (0.2, 0.2, 0.8, 0.2, 0.5, 0.5, 0.2, 0.8, 0.8, 0.8)  # apart


def draw(y: Float[Array, "n"], pixels: int = PIXELS) -> Float[Array, "pixels pixels 3"]:
    """The picture of n/2 squares with centres (x, y) in units of the image."""
    middles = (jnp.arange(pixels, dtype=y.dtype) + 0.5) / pixels
    inside = (jnp.abs(middles[None, :] - y[:, None]) <= SIDE / 2 / pixels).astype(y.dtype)
    colours = jnp.asarray(COLOURS[: y.size // 2], y.dtype)
    # a square is a product of two lines of pixels: ten times faster than asking pixel by pixel
    return jnp.einsum("kx,ky,kc->yxc", inside[0::2], inside[1::2], colours)


def box10_loss(y: Float[Array, "10"]) -> Float[Array, ""]:
    """Mean squared difference from the picture of the reference."""
    reference = draw(jnp.asarray(BOX10_REFERENCE, y.dtype))
    return jnp.mean((draw(y) - reference) ** 2)
