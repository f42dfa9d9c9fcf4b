"""Box10, occluding: a square hides those before it. The hard case: a hidden square has no gradient.

A square that is hidden at the start stays lost to whoever looks around it, even at the scale sigma.
"""

from benchmarks._task import Budget, Task
from benchmarks.tasks import boxes

TITLE = "Box10, occluding: positions of five squares that hide each other"


def build(full: bool) -> Task:
    """Starts and reference of box10."""
    return boxes.build(
        name="box10-occluding",
        title=TITLE,
        draw=boxes.draw_occluding,
        reference=boxes.on_plateau(boxes.BOX10_REFERENCE),
        start=boxes.huddled,
        budget=Budget(15_000, 120) if full else Budget(5000, 30),
        seeds=20 if full else 2,
    )
