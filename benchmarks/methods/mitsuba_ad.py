"""The renderer's own automatic differentiation, with Adam: what one uses where it works."""

from benchmarks._task import NotAble, Solve, Task
from benchmarks.methods._adam import adam

TITLE = "Mitsuba AD, Adam"


def prepare(task: Task) -> Solve:
    """Takes the gradient that the task's renderer gives, if it gives one."""
    if task.native_ad is None:
        raise NotAble("this task has no derivative of its own")
    value_and_grad = task.native_ad()
    return adam(task, lambda y: value_and_grad(y)[1], evaluations_per_step=2)
