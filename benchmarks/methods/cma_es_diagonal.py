"""CMA-ES with a diagonal covariance, as in pycma: for more parameters than a matrix is good for.

Otherwise as pycma has it: its own defaults, sigma0 and the bounds from the task. There are no
restarts, and no end but that of the budget: where many losses are the same, as on plateaus, pycma
would end a search at a quarter of it.

    R. Ros, N. Hansen: A Simple Modification in CMA-ES Achieving Linear Time and Space Complexity.
    Parallel Problem Solving from Nature (2008).
"""

import jax
import numpy as np

from benchmarks._task import NotAble, Solve, Task
from benchmarks.methods._flat import Flat, package

TITLE = "CMA-ES, diagonal (pycma)"
FEWEST = 101  # parameters, as the ZeroGrads paper has it


def prepare(task: Task) -> Solve:
    """Evaluates a whole population in one call."""
    cma = package("cma", "cma")
    flat = Flat(task)
    if flat.size < FEWEST:
        raise NotAble(f"is for {FEWEST} parameters or more; for fewer there is cma_es")

    def solve(y0, key, record):
        options = {
            "CMA_diagonal": True,
            "bounds": [np.asarray(flat.low, float), np.asarray(flat.high, float)],
            "seed": int(jax.random.randint(key, (), 1, 2**31 - 1)),
            "verbose": -9,
        }
        search = cma.CMAEvolutionStrategy(flat.start(y0), task.sigma, options)
        while True:
            points = search.ask()
            values = flat.values(np.asarray(points, flat.dtype))
            search.tell(points, np.asarray(values, float).tolist())
            record(flat.tree(search.result.xfavorite))

    return solve
