"""LED: which of 336 segments of a display are lit? A segment is on where its parameter is over 1/2.

Twelve panels of four digits with seven segments each. Each segment has three pixels, so the loss is
in proportion to the wrong switches. Sigma is that of ZeroGrads (supplement, Table 1), in units of
the domain.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import smoothdiff as sd
from benchmarks._task import Effort
from benchmarks.tasks._drawn import program

PANELS, DIGITS, SEGMENTS = (4, 3), 4, 7
SIZE = PANELS[0] * PANELS[1] * DIGITS * SEGMENTS
ON = 0.5
# the segment of each pixel of a digit; the others are dark
DIGIT = np.array(
    [[int(c) if c.isdigit() else -1 for c in row] for row in (
        ".000...", "1...2..", "1...2..", "1...2..", ".333...", "4...5..", "4...5..", "4...5..",
        ".666...", ".......", ".......",
    )]
)  # fmt: skip


# likewise of each pixel of the display
SEGMENT = np.block(
    [
        [np.where(DIGIT < 0, -1, DIGIT + SEGMENTS * k) for k in row]
        for row in np.arange(SIZE // SEGMENTS).reshape(PANELS[0], PANELS[1] * DIGITS)
    ]
)
REFERENCE = np.where(np.random.default_rng(0).random(SIZE) < 0.5, 0.25, 0.75)


def switches(y: Float[Array, "336"]) -> Bool[Array, "336"]:
    """Which segments are on."""
    return y > ON


def draw(y: Float[Array, "336"]) -> Float[Array, "44 84"]:
    """The display: a pixel is 1 where its segment is on."""
    lit = switches(y).astype(y.dtype)
    return jnp.where(SEGMENT < 0, jnp.zeros_like(y, shape=()), lit[np.maximum(SEGMENT, 0)])


def support():
    """Which pixels a parameter may change: those of its segment."""
    return sd.matrix_support(SEGMENT.reshape(-1, 1) == np.arange(SIZE), SEGMENT.shape)


# starts are anywhere in the domain, so half of the switches are wrong
TASKS = program(
    "led",
    "LED: 336 binary switches of a display",
    parameters=336,
    plateaus=True,
    draw=draw,
    reference=REFERENCE,
    support=support,
    sigma=0.33,
    effort=(Effort(8000, 120, seeds=3), Effort(60_000, 600, seeds=10)),
    image=lambda y: jnp.stack([draw(y), 0.1 * draw(y), 0.1 * draw(y)], axis=-1),
    meaning=switches,
    optimum=0.0,
    notes="Both errors are the wrong switches, relative to those of the start.",
)
