"""Central finite differences with Adam: two evaluations for each parameter in each step.

The step is wide enough to reach the reference of shadow from every start: with 0.1 or 0.02 sigma it
sees the noise of the render instead, and stays on the plateau from some.
"""

import jax
import jax.numpy as jnp

from benchmarks._task import MethodEntry, NotAble, Problem, Solve
from benchmarks.methods._adam import adam
from benchmarks.methods._flat import Flat

STEP = 0.3  # in units of the problem's sigma
BATCH = 64  # parameters at once, which bounds the memory


def prepare(problem: Problem) -> Solve:
    """Central differences need nothing but the loss, also beyond the bounds."""
    flat, step = Flat(problem), STEP * problem.sigma
    evaluations = 2 * flat.size
    if evaluations > problem.budget.evaluations:
        raise NotAble(f"needs {evaluations:,} evaluations for its first step")

    @jax.jit
    def gradient(x):
        def slope(i):
            shifted = (flat.unravel(x.at[i].add(shift)) for shift in (step, -step))
            forward, backward = map(problem.loss, shifted)
            return (forward - backward) / (2 * step)

        return jax.lax.map(slope, jnp.arange(flat.size), batch_size=BATCH)

    return adam(flat, lambda key, i, x: gradient(x), evaluations)


METHODS = {
    "finite_differences": MethodEntry(
        "Finite differences, Adam", ("scene", "program", "function"), prepare
    )
}
