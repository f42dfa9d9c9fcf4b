"""Texture256: 256 x 256 texels in RGB, each seen as it is: many parameters and nothing else.

Sigma and the starts are those of ZeroGrads (supplement, Table 1 and section 2.2).
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks._task import Effort, Problem, Score, Task, entry

PIXELS = 256
SHAPE = (PIXELS, PIXELS, 3)


Y, X, CHANNEL = np.meshgrid(*(np.arange(n) / n for n in SHAPE), indexing="ij")
WAVES = np.sin(2 * np.pi * (2 * X + Y + CHANNEL)) * np.cos(6 * np.pi * (X - 0.5) * Y + CHANNEL)
REFERENCE = 0.5 + 0.4 * np.where(X + Y < 1, WAVES, -WAVES)  # with an edge


def build(full: bool, **named: Any) -> Task:
    """Starts are grey with a little noise."""
    reference = jnp.asarray(REFERENCE, jnp.float32)
    much = Effort(100_000, 1200, seeds=10) if full else Effort(2000, 120, seeds=1)
    itself = lambda y: y
    return Task(
        problem=Problem(
            (jnp.zeros(SHAPE), jnp.ones(SHAPE)),
            0.025,
            much.budget,
            loss=lambda y: jnp.mean((y - reference) ** 2),
            terms=lambda y: (y - reference) ** 2 / reference.size,
            support=itself,
        ),
        score=Score(reference, image=itself),
        start=lambda seed: 0.5 + 0.05 * jax.random.normal(jax.random.key(seed), SHAPE),
        seeds=much.seeds,
        **named,
    )


TASKS = entry(
    "program",
    build,
    "texture256",
    "Texture256: 196,608 values of a texture",
    parameters=196_608,
    plateaus=False,
)
