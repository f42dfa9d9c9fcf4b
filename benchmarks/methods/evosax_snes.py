"""Separable natural evolution strategies (SNES) as in evosax, with its own defaults.

Of evosax's strategies that adapt their scale it is the most reliable on Quad, Box2 and Box10: its
CMA-ES, Sep-CMA-ES, MA-ES and CR-FM-NES turn to NaN once they have converged, and none of them finds
Box10. The price is Rosenbrock's valley, which a separable strategy follows slowly.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks._task import Solve, Task
from benchmarks.methods._flat import Flat, package

TITLE = "SNES (evosax)"


def prepare(task: Task) -> Solve:
    """Compiles a generation: the samples, their losses at the clipped points, the update."""
    algorithms = package("evosax.algorithms", "evosax")
    flat = Flat(task)
    population = 4 + int(3 * np.log(flat.size))
    population += population % 2
    snes = algorithms.SNES(population_size=population, solution=jnp.zeros(flat.size, flat.dtype))
    params = snes.default_params.replace(std_init=task.sigma)

    @jax.jit
    def generation(key, state):
        draw, update = jax.random.split(key)
        points, state = snes.ask(draw, state, params)
        return snes.tell(update, points, flat.values(points), state, params)[0]

    def solve(y0, key, record):
        state = snes.init(key, jnp.asarray(flat.start(y0), flat.dtype), params)
        for i in itertools.count():
            state = generation(jax.random.fold_in(key, i), state)
            record(flat.tree(snes.get_mean(state)))

    return solve
