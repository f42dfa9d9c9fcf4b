"""Hard-edged coloured squares whose positions are sought.

The loss is piecewise constant, so its derivative is zero wherever it exists. References are in the
middle of a plateau. Where squares hide each other, a hidden one has no gradient: one that is hidden
at the start stays lost to whoever looks around it, even at the scale sigma.
"""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks._task import Effort
from benchmarks.tasks._drawn import function, uniform

PIXELS = 64
SIDE = 13  # of a square, in pixels
COLOURS = ((0.9, 0.1, 0.1), (0.1, 0.8, 0.1), (0.1, 0.2, 0.9), (0.8, 0.7, 0.1), (0.6, 0.1, 0.7))
BOX10_START = (0.46, 0.46, 0.54, 0.46, 0.5, 0.5, 0.46, 0.54, 0.54, 0.54)  # huddled
BOX10_REFERENCE = (0.2, 0.2, 0.8, 0.2, 0.5, 0.5, 0.2, 0.8, 0.8, 0.8)  # apart


def on_plateau(y: Sequence[float]) -> np.ndarray:
    """The positions from which a move of less than half a pixel changes nothing, next to y."""
    return (np.floor(np.asarray(y) * PIXELS) + 0.5) / PIXELS


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


def draw_occluding(y: Float[Array, "n"]) -> Float[Array, "pixels pixels 3"]:
    """The same, but a square hides those before it."""
    inside = _lines(y, PIXELS)
    image = jnp.zeros((PIXELS, PIXELS, 3), y.dtype)
    for x_line, y_line, colour in zip(inside[0::2], inside[1::2], COLOURS, strict=False):
        covered = (y_line[:, None] * x_line[None, :])[..., None]
        image = jnp.where(covered > 0, jnp.asarray(colour, y.dtype)[None, None], image)
    return image


def box10_loss(y: Float[Array, "10"]) -> Float[Array, ""]:
    """Mean squared difference from the picture of the reference."""
    reference = draw(jnp.asarray(BOX10_REFERENCE, y.dtype))
    return jnp.mean((draw(y) - reference) ** 2)


SHARED: dict[str, Any] = {
    "sigma": 0.15,
    "bounds": (0.1, 0.9),  # within, a square is in the image
    "notes": f"{PIXELS} x {PIXELS} pixels",
}
# starts are huddled, so that each square hinders the others, and are sought apart
FIVE: dict[str, Any] = SHARED | {
    "reference": on_plateau(BOX10_REFERENCE),
    "start": uniform(10, -0.02, 0.02, around=BOX10_START),
    "effort": (Effort(5000, 30, seeds=2), Effort(15_000, 120, seeds=20)),
}
TASKS = (
    function(
        "box2",
        "Box2: position of a square",
        parameters=2,
        plateaus=True,
        draw=draw,
        image=draw,
        reference=on_plateau((0.5, 0.5)),
        start=uniform(2, 0.15, 0.85),  # anywhere in the image
        effort=(Effort(1000, 10, seeds=3), Effort(5000, 60, seeds=20)),
        **SHARED,
    )
    | function(
        "box10",
        "Box10: positions of five squares whose colours add up",
        parameters=10,
        plateaus=True,
        draw=draw,
        image=draw,
        **FIVE,
    )
    | function(
        "box10-occluding",
        "Box10, occluding: positions of five squares that hide each other",
        parameters=10,
        plateaus=True,
        draw=draw_occluding,
        image=draw_occluding,
        **FIVE,
    )
)
