"""Wicker: how many stakes has a woven texture, and how often is it repeated? Three integers.

Each parameter is a share of its range of integers, so the loss is constant on each of 256 boxes.
Sigma is that of ZeroGrads (supplement, Table 1), in units of the domain.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks._task import Effort
from benchmarks.tasks._drawn import program

PIXELS = 64
FEWEST, CHOICES = np.array([2, 2, 1]), np.array([8, 8, 4])  # upright stakes, others, repetitions
COUNTS = np.array([4, 6, 2])  # those that are sought
REFERENCE = (COUNTS - FEWEST + 0.5) / CHOICES
RIM, DARK = 0.06, 0.1  # around each repetition
UPRIGHT, ACROSS = (0.9, 0.6, 0.3), (0.6, 0.35, 0.2)


def counts(y: Float[Array, "3"]) -> Float[Array, "3"]:
    """The integers."""
    choices = jnp.asarray(CHOICES, y.dtype)
    return jnp.asarray(FEWEST, y.dtype) + jnp.clip(jnp.floor(y * choices), 0, choices - 1)


def draw(y: Float[Array, "3"]) -> Float[Array, "64 64 3"]:
    """The texture: stakes that go over and under each other in turn."""
    upright, across, repetitions = counts(y)
    middles = jnp.asarray((np.arange(PIXELS) + 0.5) / PIXELS, y.dtype)
    tile = repetitions * middles % 1
    rim = (tile < RIM) | (tile > 1 - RIM)
    (i, s), (j, t) = (jnp.divmod(n * tile, 1) for n in (upright, across))
    column, row = jnp.meshgrid(i, j)
    on_top = ((column + row) % 2 == 0)[..., None]
    round_ = lambda at: jnp.sin(jnp.pi * at)
    colour = lambda rgb: jnp.asarray(rgb, y.dtype)[None, None]
    weave = jnp.where(
        on_top,
        colour(UPRIGHT) * round_(s)[None, :, None],
        colour(ACROSS) * round_(t)[:, None, None],
    )
    return jnp.where((rim[None, :] | rim[:, None])[..., None], DARK, weave)


TASKS = program(
    "wicker",
    "Wicker: integer counts of a woven texture",
    parameters=3,
    plateaus=True,
    draw=draw,
    reference=REFERENCE,
    sigma=0.33,
    effort=(Effort(600, 60, seeds=3), Effort(3000, 240, seeds=10)),
    image=draw,
    meaning=counts,
    optimum=0.0,
    notes=f"{PIXELS} x {PIXELS} pixels",
)
