"""Box2: where is the square?"""

import jax

from benchmarks._task import Budget, Task
from benchmarks.tasks import boxes

TITLE = "Box2: position of a square"


def build(full: bool) -> Task:
    """Starts are anywhere in the image."""
    return boxes.build(
        name="box2",
        title=TITLE,
        draw=boxes.draw,
        reference=boxes.on_plateau((0.5, 0.5)),
        start=lambda seed: jax.random.uniform(jax.random.key(seed), (2,), minval=0.15, maxval=0.85),
        budget=Budget(5000, 60) if full else Budget(1000, 10),
        seeds=20 if full else 3,
    )
