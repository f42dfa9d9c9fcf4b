"""Hard-edged coloured squares whose positions are sought.

The loss is piecewise constant, so its derivative is zero wherever it exists. References are in the
middle of a plateau. Where squares hide each other, a hidden one has no gradient: one that is hidden
at the start stays lost to whoever looks around it, even at the scale sigma.
"""

from collections.abc import Callable, Sequence
from functools import partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks._task import Budget, Task, TaskEntry
from benchmarks.tasks._drawn import drawn, uniform

PIXELS = 64
SIDE = 13  # of a square, in pixels
COLOURS = ((0.9, 0.1, 0.1), (0.1, 0.8, 0.1), (0.1, 0.2, 0.9), (0.8, 0.7, 0.1), (0.6, 0.1, 0.7))
BOX10_START = (0.46, 0.46, 0.54, 0.46, 0.5, 0.5, 0.46, 0.54, 0.54, 0.54)  # huddled
BOX10_REFERENCE = (0.2, 0.2, 0.8, 0.2, 0.5, 0.5, 0.2, 0.8, 0.8, 0.8)  # apart
SIGMA = 0.15
BOUNDS = (0.1, 0.9)  # within, a square is in the image


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


def one(full: bool) -> Task:
    """Starts are anywhere in the image."""
    budget = Budget(5000, 60) if full else Budget(1000, 10)
    start = uniform(2, 0.15, 0.85)
    return _task("box2", draw, (0.5, 0.5), start, budget, 20 if full else 3)


def five(name: str, draw: Callable[[Array], Array], full: bool) -> Task:
    """Starts are huddled, so that each square hinders the others, and are sought apart."""
    budget = Budget(15_000, 120) if full else Budget(5000, 30)
    start = uniform(10, -0.02, 0.02, around=BOX10_START)
    return _task(name, draw, BOX10_REFERENCE, start, budget, 20 if full else 2)


def _task(
    name: str,
    draw: Callable[[Array], Array],
    reference: Sequence[float],
    start: Callable[[int], Array],
    budget: Budget,
    seeds: int,
) -> Task:
    return drawn(
        name,
        TASKS[name].title,
        draw,
        on_plateau(reference),
        sigma=SIGMA,
        budget=budget,
        seeds=seeds,
        start=start,
        bounds=BOUNDS,
        image=draw,
        notes=f"{PIXELS} x {PIXELS} pixels",
    )


TASKS = {
    "box2": TaskEntry("Box2: position of a square", "function", one),
    "box10": TaskEntry(
        "Box10: positions of five squares whose colours add up",
        "function",
        partial(five, "box10", draw),
    ),
    "box10-occluding": TaskEntry(
        "Box10, occluding: positions of five squares that hide each other",
        "function",
        partial(five, "box10-occluding", draw_occluding),
    ),
}
