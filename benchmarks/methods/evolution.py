"""Searches by populations of other libraries; sigma and the bounds come from the problem.

CMA-ES as in pycma, with its own defaults: with restarts, and with a diagonal covariance, for more
parameters than a matrix is good for:

    R. Ros, N. Hansen: A Simple Modification in CMA-ES Achieving Linear Time and Space Complexity.
    Parallel Problem Solving from Nature (2008).

Separable natural evolution strategies (SNES) as in evosax, with its own defaults. Of evosax's
strategies that adapt their scale it is the most reliable on Quad, Box2 and Box10: its CMA-ES,
Sep-CMA-ES, MA-ES and CR-FM-NES turn to NaN once they have converged, and none of them finds Box10.
The price is Rosenbrock's valley, which a separable strategy follows slowly.

A genetic algorithm as in PyGAD, with its own defaults for selection, crossover and mutation.
"""

import itertools
import logging
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks._task import MethodEntry, NotAble, Problem, Solve
from benchmarks.methods._flat import Flat, package, seed_of

MOST = 3000  # parameters of which a matrix is worth a try
FEWEST = 101  # parameters of the diagonal one, as the ZeroGrads paper has it
POPULATION, PARENTS = 50, 10  # of the genetic algorithm
MOST_GENES = 100_000  # PyGAD goes through them one by one
SILENT = logging.Logger("silent", logging.CRITICAL + 1)  # it would log how record ends a run


def cma_es(problem: Problem, *, first: float = 1.0) -> Solve:
    """When it stops it starts again from a random point with twice the population (IPOP).

    As `cma.fmin2` does with `restarts`. A restart is shown once it has seen something better than
    all before it. `first` is the first step size, in units of sigma.
    """
    cma, flat = package("cma", "cma"), Flat(problem)
    if flat.size > MOST:
        raise NotAble(f"is for up to {MOST} parameters; for more there is cma_es_diagonal")
    # pycma 4 raises where it would cut the width in 1-D
    width = {"maxstd": np.inf} if flat.size == 1 else {}

    def solve(y0, key, record):
        random = np.random.default_rng(seed_of(key))
        start, lowest, shown = flat.start(y0), np.inf, y0
        for restart in itertools.count():
            options = width | {"popsize": _usual_population(flat) * 2**restart}
            search = _search(cma, flat, start, int(random.integers(1, 2**31)), options, first)
            while not search.stop():
                _generation(search, flat)
                if search.best.f < lowest:
                    shown = flat.tree(search.result.xfavorite)
                record(shown)
            lowest = min(lowest, search.best.f)
            start = random.uniform(*flat.box)

    return solve


def cma_es_diagonal(problem: Problem) -> Solve:
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


def _usual_population(flat: Flat) -> int:
    """pycma's own."""
    return 4 + int(3 * np.log(flat.size))


def _search(
    cma: Any, flat: Flat, start: np.ndarray, seed: int, options: dict, first: float = 1.0
) -> Any:
    usual = {"bounds": list(flat.box), "seed": seed, "verbose": -9}
    return cma.CMAEvolutionStrategy(start, first * flat.problem.sigma, usual | options)


def _generation(search: Any, flat: Flat) -> None:
    """Evaluates a whole population in one call."""
    points = search.ask()
    search.tell(points, flat.batch(points).tolist())


def snes(problem: Problem) -> Solve:
    """Compiles a generation: the samples, their losses at the clipped points, the update."""
    algorithms, flat = package("evosax.algorithms", "evosax"), Flat(problem)
    population = _usual_population(flat)
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


def genetic_algorithm(problem: Problem) -> Solve:
    """The first population is the start and normal samples around it; mutations are up to sigma."""
    pygad, flat = package("pygad", "pygad"), Flat(problem)
    if flat.size > MOST_GENES:
        raise NotAble(f"takes minutes for a generation of more than {MOST_GENES} parameters")

    def solve(y0, key, record):
        seed, start = seed_of(key), flat.start(y0)
        random = np.random.default_rng(seed)
        population = random.normal(start, problem.sigma, (POPULATION, flat.size))
        population[0] = start
        lowest, shown = np.inf, y0

        def fitness(_, genes, indices):
            nonlocal lowest, shown
            values = flat.batch(genes)
            if values.min() < lowest:
                lowest, shown = values.min(), flat.tree(genes[values.argmin()])
            return (-values).tolist()

        pygad.GA(
            num_generations=2**31,  # record ends it
            num_parents_mating=PARENTS,
            fitness_func=fitness,
            fitness_batch_size=POPULATION,
            initial_population=np.clip(population, *flat.box),
            random_mutation_min_val=-problem.sigma,
            random_mutation_max_val=problem.sigma,
            on_generation=lambda _: record(shown),
            random_seed=seed,
            suppress_warnings=True,
            logger=SILENT,
        ).run()

    return solve


METHODS = {
    "cma_es": MethodEntry(
        "CMA-ES with restarts (pycma)",
        ("scene", "program", "function"),
        cma_es,
        {"first": (0.5, 1.0, 2.0)},
    ),
    "cma_es_diagonal": MethodEntry(
        "CMA-ES, diagonal (pycma)", ("large", "program"), cma_es_diagonal
    ),
    "evosax_snes": MethodEntry("SNES (evosax)", ("program",), snes),
    "genetic_algorithm": MethodEntry(
        "Genetic algorithm (PyGAD)", ("scene", "program"), genetic_algorithm
    ),
}
