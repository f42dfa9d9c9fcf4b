"""Box10: five squares that start huddled and are sought apart; their colours add up."""

from benchmarks._task import Budget, Task
from benchmarks.tasks import boxes

TITLE = "Box10: positions of five squares whose colours add up"


def build(full: bool) -> Task:
    """As the squares overlap at the start, each hinders the others."""
    return boxes.build(
        name="box10",
        title=TITLE,
        draw=boxes.draw,
        reference=boxes.on_plateau(boxes.BOX10_REFERENCE),
        start=boxes.huddled,
        budget=Budget(15_000, 120) if full else Budget(5000, 30),
        seeds=20 if full else 2,
    )
