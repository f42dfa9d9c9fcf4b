"""Central finite differences with Adam: two evaluations for each parameter in each step.

The step is wide enough to reach the reference of shadow from every start: with 0.1 or 0.02 sigma it
sees the noise of the render instead, and stays on the plateau from some.
"""

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from benchmarks._task import Solve, Task
from benchmarks.methods._adam import adam

TITLE = "Finite differences, Adam"
STEP = 0.3  # in units of the task's sigma
BATCH = 64  # parameters at once, which bounds the memory


def prepare(task: Task) -> Solve:
    """Central differences need nothing but the loss."""
    reference, unravel = ravel_pytree(task.reference)
    step = STEP * task.sigma

    @jax.jit
    def gradient(y):
        flat, _ = ravel_pytree(y)

        def slope(i):
            forward, backward = (task.loss(unravel(flat.at[i].add(h))) for h in (step, -step))
            return (forward - backward) / (2 * step)

        return unravel(jax.lax.map(slope, jnp.arange(flat.size), batch_size=BATCH))

    return adam(task, gradient, evaluations_per_step=2 * reference.size)
