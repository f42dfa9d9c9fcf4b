"""SPSA: a slope from two evaluations, at the ends of a random diagonal, in each step.

As the ZeroGrads paper has it, the first perturbation is as wide as sigma. The gains fall as Spall
recommends; the first one makes the first steps about a tenth of sigma in each parameter, by the
size of a few slopes at the start, which are counted.

    J. C. Spall: Implementation of the Simultaneous Perturbation Algorithm for Stochastic
    Optimization. IEEE Transactions on Aerospace and Electronic Systems 34 (1998).
"""

import itertools

import jax
import jax.numpy as jnp

from benchmarks._task import MethodEntry, Problem, Solve
from benchmarks.methods._flat import Flat

STEP_DECAY, WIDTH_DECAY = 0.602, 0.101  # Spall's alpha and gamma
STABILITY = 0.1  # of all steps: so many come before the first, as it were
FIRST_STEP = 0.1  # in units of sigma
PILOTS = 5


def prepare(problem: Problem, *, first: float = FIRST_STEP, width: float = 1.0) -> Solve:
    """Compiles the two evaluations of a step, and the step.

    The first step and the first perturbation are in units of sigma.
    """
    flat, wide = Flat(problem), width * problem.sigma
    before = STABILITY * problem.budget.evaluations / 2 + 1

    @jax.jit
    def slope(key, x, width):
        """The slope along a diagonal, and the diagonal."""
        diagonal = jax.random.rademacher(key, (flat.size,), flat.dtype)
        ends = flat.values(jnp.stack([x + width * diagonal, x - width * diagonal]))
        return (ends[0] - ends[1]) / (2 * width), diagonal

    @jax.jit
    def step(key, x, i, gain):
        along, diagonal = slope(key, x, wide / (i + 1) ** WIDTH_DECAY)
        return flat.clip(x - gain / (i + before) ** STEP_DECAY * along * diagonal)

    def solve(y0, key, record):
        x = jnp.asarray(flat.start(y0), flat.dtype)
        keys = (jax.random.fold_in(key, i) for i in itertools.count())
        size = 0.0
        while size == 0:  # on a plateau a slope says nothing
            size = sum(abs(float(slope(next(keys), x, wide)[0])) for _ in range(PILOTS))
            record(flat.tree(x))
        gain = first * problem.sigma * before**STEP_DECAY * PILOTS / size
        gain = jnp.asarray(gain, flat.dtype)
        for i in itertools.count():
            x = step(next(keys), x, jnp.asarray(i, flat.dtype), gain)
            record(flat.tree(x))

    return solve


GRID = {"first": (0.1, 0.2, 0.4), "width": (0.5, 1.0, 2.0)}
METHODS = {"spsa": MethodEntry("SPSA", ("scene", "large", "program"), prepare, GRID)}
