"""Texture256: 256 x 256 texels in RGB, each seen as it is: many parameters and nothing else.

Sigma and the starts are those of ZeroGrads (supplement, Table 1 and section 2.2).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks._task import Budget, Problem, Score, Task, TaskEntry

PIXELS = 256
SHAPE = (PIXELS, PIXELS, 3)


def _waves() -> np.ndarray:
    """Waves in each channel, with an edge."""
    y, x, channel = np.meshgrid(*(np.arange(n) / n for n in SHAPE), indexing="ij")
    waves = np.sin(2 * np.pi * (2 * x + y + channel)) * np.cos(6 * np.pi * (x - 0.5) * y + channel)
    return 0.5 + 0.4 * np.where(x + y < 1, waves, -waves)


REFERENCE = _waves()


def build(full: bool) -> Task:
    """Starts are grey with a little noise."""
    reference = jnp.asarray(REFERENCE, jnp.float32)
    loss = lambda y: jnp.mean((y - reference) ** 2)

    def terms(y: Float[Array, "256 256 3"]) -> Float[Array, "256 256 3"]:
        return (y - reference) ** 2 / reference.size

    itself = lambda y: y
    budget = Budget(100_000, 1200) if full else Budget(2000, 120)
    bounds = jnp.zeros(SHAPE), jnp.ones(SHAPE)
    return Task(
        "texture256",
        TASKS["texture256"].title,
        Problem(bounds, 0.025, budget, loss, terms=terms, support=itself),
        Score(reference, image=itself),
        start=lambda seed: 0.5 + 0.05 * jax.random.normal(jax.random.key(seed), SHAPE),
        seeds=10 if full else 1,
    )


TASKS = {
    "texture256": TaskEntry("Texture256: 196,608 values of a texture", "program", build),
}
