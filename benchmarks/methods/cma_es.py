"""CMA-ES as in pycma, with its own defaults; sigma0 and the bounds come from the task."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from benchmarks._task import Solve, Task

TITLE = "CMA-ES (pycma)"


def prepare(task: Task) -> Solve:
    """Evaluates a whole population in one call."""
    import cma

    reference, unravel = ravel_pytree(task.reference)
    losses = jax.jit(jax.vmap(lambda flat: task.loss(unravel(flat))))
    low, high = (np.asarray(ravel_pytree(bound)[0], float) for bound in task.bounds)

    def solve(y0, key, record):
        options = {
            "bounds": [low, high],
            "seed": int(jax.random.randint(key, (), 1, 2**31 - 1)),
            "verbose": -9,
        }
        start = np.asarray(ravel_pytree(y0)[0], float)
        search = cma.CMAEvolutionStrategy(start, task.sigma, options)
        while not search.stop():
            points = search.ask()
            search.tell(points, np.asarray(losses(np.asarray(points, reference.dtype))).tolist())
            record(unravel(jnp.asarray(search.result.xfavorite, reference.dtype)))

    return solve
