"""CMA-ES as in pycma, with its own defaults; sigma0 and the bounds come from the task.

When it stops it starts again from a random point with twice the population, as `cma.fmin2` does
with `restarts` (IPOP). A restart is shown once it has seen something better than all before it.
"""

import itertools

import jax
import numpy as np

from benchmarks._task import Solve, Task
from benchmarks.methods._flat import Flat, package

TITLE = "CMA-ES with restarts (pycma)"


def prepare(task: Task) -> Solve:
    """Evaluates a whole population in one call."""
    cma = package("cma", "cma")
    flat = Flat(task)
    low, high = np.asarray(flat.low, float), np.asarray(flat.high, float)

    def solve(y0, key, record):
        random = np.random.default_rng(int(jax.random.randint(key, (), 1, 2**31 - 1)))
        population = 4 + int(3 * np.log(flat.size))  # pycma's own
        start, lowest, shown = flat.start(y0), np.inf, y0
        for restart in itertools.count():
            options = {
                "bounds": [low, high],
                "seed": int(random.integers(1, 2**31)),
                "popsize": population * 2**restart,
                "verbose": -9,
            }
            if flat.size == 1:
                options["maxstd"] = np.inf  # pycma 4 raises where it would cut the width in 1-D
            search = cma.CMAEvolutionStrategy(start, task.sigma, options)
            while not search.stop():
                points = search.ask()
                values = flat.values(np.asarray(points, flat.dtype))
                search.tell(points, np.asarray(values, float).tolist())
                if search.best.f < lowest:
                    shown = flat.tree(search.result.xfavorite)
                record(shown)
            lowest = min(lowest, search.best.f)
            start = random.uniform(low, high)

    return solve
