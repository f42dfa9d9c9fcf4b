"""CMA-ES as in pycma, with its own defaults; sigma0 and the bounds come from the problem.

Beside the usual one, with restarts, there is the one with a diagonal covariance, for more
parameters than a matrix is good for:

    R. Ros, N. Hansen: A Simple Modification in CMA-ES Achieving Linear Time and Space Complexity.
    Parallel Problem Solving from Nature (2008).
"""

import itertools
from typing import Any

import numpy as np

from benchmarks._task import MethodEntry, NotAble, Problem, Solve
from benchmarks.methods._flat import Flat, package, seed_of

MOST = 3000  # parameters of which a matrix is worth a try
FEWEST = 101  # parameters of the diagonal one, as the ZeroGrads paper has it


def restarting(problem: Problem) -> Solve:
    """When it stops it starts again from a random point with twice the population (IPOP).

    As `cma.fmin2` does with `restarts`. A restart is shown once it has seen something better than
    all before it.
    """
    cma, flat = package("cma", "cma"), Flat(problem)
    if flat.size > MOST:
        raise NotAble(f"is for up to {MOST} parameters; for more there is cma_es_diagonal")
    population = 4 + int(3 * np.log(flat.size))  # pycma's own
    # pycma 4 raises where it would cut the width in 1-D
    width = {"maxstd": np.inf} if flat.size == 1 else {}

    def solve(y0, key, record):
        random = np.random.default_rng(seed_of(key))
        start, lowest, shown = flat.start(y0), np.inf, y0
        for restart in itertools.count():
            options = width | {"popsize": population * 2**restart}
            search = _search(cma, flat, start, int(random.integers(1, 2**31)), options)
            while not search.stop():
                _generation(search, flat)
                if search.best.f < lowest:
                    shown = flat.tree(search.result.xfavorite)
                record(shown)
            lowest = min(lowest, search.best.f)
            start = random.uniform(*flat.box)

    return solve


def diagonal(problem: Problem) -> Solve:
    """There are no restarts, and no end but that of the budget.

    Where many losses are the same, as on plateaus, pycma would end a search at a quarter of it.
    """
    cma, flat = package("cma", "cma"), Flat(problem)
    if flat.size < FEWEST:
        raise NotAble(f"is for {FEWEST} parameters or more; for fewer there is cma_es")

    def solve(y0, key, record):
        search = _search(cma, flat, flat.start(y0), seed_of(key), {"CMA_diagonal": True})
        while True:
            _generation(search, flat)
            record(flat.tree(search.result.xfavorite))

    return solve


def _search(cma: Any, flat: Flat, start: np.ndarray, seed: int, options: dict) -> Any:
    usual = {"bounds": list(flat.box), "seed": seed, "verbose": -9}
    return cma.CMAEvolutionStrategy(start, flat.problem.sigma, usual | options)


def _generation(search: Any, flat: Flat) -> None:
    """Evaluates a whole population in one call."""
    points = search.ask()
    search.tell(points, flat.batch(points).tolist())


METHODS = {
    "cma_es": MethodEntry(
        "CMA-ES with restarts (pycma)", ("scene", "program", "function"), restarting
    ),
    "cma_es_diagonal": MethodEntry("CMA-ES, diagonal (pycma)", ("large", "program"), diagonal),
}
