"""Adam as all first-order methods use it: one learning rate, linearly decayed over the budget.

The rate is the best compromise of smoothed gradients on shadow and Box10, from 0.03 to 0.25 sigma.
"""

from collections.abc import Callable

import jax
import optax

from benchmarks._task import Solve, Task, Y

LEARNING_RATE = 0.15  # in units of the task's sigma
DECAY = 0.02  # what is left of it at the end


def optimiser(task: Task, evaluations_per_step: int) -> optax.GradientTransformation:
    """Adam for a task, for a method that spends so many evaluations on a step."""
    steps = task.budget.evaluations // evaluations_per_step
    rate = LEARNING_RATE * task.sigma
    return optax.adam(optax.linear_schedule(rate, DECAY * rate, steps))


def adam(task: Task, gradient: Callable[[Y], Y], evaluations_per_step: int) -> Solve:
    """Adam on `gradient(y)`, projected to the bounds: for methods without a loop of their own."""
    optim = optimiser(task, evaluations_per_step)

    @jax.jit
    def update(y, state, grad):
        updates, state = optim.update(grad, state, y)
        y = optax.projections.projection_box(optax.apply_updates(y, updates), *task.bounds)
        return y, state

    def solve(y0, key, record):
        y, state = y0, optim.init(y0)
        while True:
            y, state = update(y, state, gradient(y))
            record(y)

    return solve
