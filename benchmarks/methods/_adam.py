"""Adam as all first-order methods use it: one learning rate, linearly decayed over the budget.

The rate is the best compromise of smoothed gradients on shadow and Box10, from 0.03 to 0.25 sigma.
"""

from collections.abc import Callable

import jax
import optax

from benchmarks._task import Key, Problem, Solve
from benchmarks.methods._flat import Flat

LEARNING_RATE = 0.15  # in units of the problem's sigma
DECAY = 0.02  # what is left of it at the end


def optimiser(problem: Problem, evaluations_per_step: int) -> optax.GradientTransformation:
    """Adam for a problem, for a method that spends so many evaluations on a step."""
    steps = problem.budget.evaluations // evaluations_per_step
    rate = LEARNING_RATE * problem.sigma
    return optax.adam(optax.linear_schedule(rate, DECAY * rate, steps))


def adam(
    flat: Flat, gradient: Callable[[Key, int, jax.Array], jax.Array], evaluations_per_step: int
) -> Solve:
    """Adam on `gradient(key, i, x)` of step i, within the bounds; it is called as it is."""
    optim = optimiser(flat.problem, evaluations_per_step)

    @jax.jit
    def move(x, state, slope):
        updates, state = optim.update(slope, state, x)
        return flat.clip(x + updates), state

    return flat.iterate(lambda key, i, x, state: move(x, state, gradient(key, i, x)), optim.init)
