"""Hard-edged coloured squares whose positions are sought, as in box2 and box10.

The loss is piecewise constant, so its derivative is zero wherever it exists. References are in the
middle of a plateau.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks._task import Budget, Task

PIXELS = 64
SIDE = 13  # of a square, in pixels
COLOURS = ((0.9, 0.1, 0.1), (0.1, 0.8, 0.1), (0.1, 0.2, 0.9), (0.8, 0.7, 0.1), (0.6, 0.1, 0.7))
BOX10_START = (0.46, 0.46, 0.54, 0.46, 0.5, 0.5, 0.46, 0.54, 0.54, 0.54)  # huddled
BOX10_REFERENCE = (0.2, 0.2, 0.8, 0.2, 0.5, 0.5, 0.2, 0.8, 0.8, 0.8)  # apart
SIGMA = 0.15
BOUNDS = (0.1, 0.9)  # within, a square is in the image


def on_plateau(y) -> np.ndarray:
    """The positions from which a move of less than half a pixel changes nothing, next to y."""
    return ((np.floor(np.asarray(y) * PIXELS) + 0.5) / PIXELS).astype(np.float32)


def build(
    name: str,
    title: str,
    draw: Callable[[Array], Array],
    reference: np.ndarray,
    start: Callable[[int], Array],
    budget: Budget,
    seeds: int,
) -> Task:
    """The task of finding the squares of the picture at the reference."""
    target = draw(jnp.asarray(reference))

    def residuals(y: Float[Array, "n"]) -> Float[Array, "pixels pixels 3"]:
        return draw(y) - target

    def loss(y: Float[Array, "n"]) -> Float[Array, ""]:
        return jnp.mean(residuals(y) ** 2)

    return Task(
        name=name,
        title=title,
        loss=loss,
        exact_loss=loss,
        start=start,
        reference=jnp.asarray(reference),
        bounds=(jnp.full_like(reference, BOUNDS[0]), jnp.full_like(reference, BOUNDS[1])),
        sigma=SIGMA,
        budget=budget,
        seeds=seeds,
        image=draw,
        residuals=residuals,
        notes=f"{PIXELS} x {PIXELS} pixels",
    )


def huddled(seed: int) -> Float[Array, "10"]:
    """Five squares close to one another, a little apart from seed to seed."""
    start = jnp.asarray(BOX10_START)
    return start + jax.random.uniform(jax.random.key(seed), start.shape, minval=-0.02, maxval=0.02)


def _lines(y: Float[Array, "n"], pixels: int) -> Float[Array, "n pixels"]:
    """Which columns (even rows) and lines (odd) of pixels each square covers, 1 or 0."""
    middles = (jnp.arange(pixels, dtype=y.dtype) + 0.5) / pixels
    return (jnp.abs(middles[None, :] - y[:, None]) <= SIDE / 2 / pixels).astype(y.dtype)


def draw(y: Float[Array, "n"], pixels: int = PIXELS) -> Float[Array, "pixels pixels 3"]:
    """The picture of n/2 squares with centres (x, y) in units of the image; colours add up."""
    inside = _lines(y, pixels)
    colours = jnp.asarray(COLOURS[: y.size // 2], y.dtype)
    # a square is a product of two lines of pixels: ten times faster than asking pixel by pixel
    return jnp.einsum("kx,ky,kc->yxc", inside[0::2], inside[1::2], colours)


def draw_occluding(y: Float[Array, "n"], pixels: int = PIXELS) -> Float[Array, "pixels pixels 3"]:
    """The same, but a square hides those before it."""
    inside = _lines(y, pixels)
    image = jnp.zeros((pixels, pixels, 3), y.dtype)
    for x_line, y_line, colour in zip(inside[0::2], inside[1::2], COLOURS, strict=False):
        covered = (y_line[:, None] * x_line[None, :])[..., None]
        image = jnp.where(covered > 0, jnp.asarray(colour, y.dtype)[None, None], image)
    return image


def box10_loss(y: Float[Array, "10"]) -> Float[Array, ""]:
    """Mean squared difference from the picture of the reference."""
    reference = draw(jnp.asarray(BOX10_REFERENCE, y.dtype))
    return jnp.mean((draw(y) - reference) ** 2)
