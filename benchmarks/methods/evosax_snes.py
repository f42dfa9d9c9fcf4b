"""Separable natural evolution strategies (SNES) as in evosax, with its own defaults.

Of evosax's strategies that adapt their scale it is the most reliable on Quad, Box2 and Box10: its
CMA-ES, Sep-CMA-ES, MA-ES and CR-FM-NES turn to NaN once they have converged, and none of them finds
Box10. The price is Rosenbrock's valley, which a separable strategy follows slowly.
"""

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks._task import MethodEntry, Problem, Solve
from benchmarks.methods._flat import Flat, package


def prepare(problem: Problem) -> Solve:
    """Compiles a generation: the samples, their losses at the clipped points, the update."""
    algorithms = package("evosax.algorithms", "evosax")
    flat = Flat(problem)
    population = 4 + int(3 * np.log(flat.size))
    population += population % 2
    snes = algorithms.SNES(population_size=population, solution=jnp.zeros(flat.size, flat.dtype))
    params = snes.default_params.replace(std_init=problem.sigma)

    @jax.jit
    def generation(key, i, mean, state):
        draw, update = jax.random.split(key)
        points, state = snes.ask(draw, state, params)
        state = snes.tell(update, points, flat.values(points), state, params)[0]
        return snes.get_mean(state), state

    unused = jax.random.key(0)  # nothing is drawn for the first state
    return flat.iterate(generation, lambda x: snes.init(unused, x, params))


METHODS = {"evosax_snes": MethodEntry("SNES (evosax)", ("program",), prepare)}
