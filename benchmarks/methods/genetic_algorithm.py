"""A genetic algorithm as in PyGAD, with its own defaults for selection, crossover and mutation.

The first population is the start and normal samples around it; mutations are up to sigma.
"""

import logging

import numpy as np

from benchmarks._task import MethodEntry, NotAble, Problem, Solve
from benchmarks.methods._flat import Flat, package, seed_of

POPULATION = 50
PARENTS = 10
MOST = 100_000  # parameters: PyGAD goes through them one by one
SILENT = logging.Logger("silent", logging.CRITICAL + 1)  # it would log how record ends a run


def prepare(problem: Problem) -> Solve:
    """Evaluates a whole generation in one call."""
    pygad, flat = package("pygad", "pygad"), Flat(problem)
    if flat.size > MOST:
        raise NotAble(f"takes minutes for a generation of more than {MOST} parameters")

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
    "genetic_algorithm": MethodEntry("Genetic algorithm (PyGAD)", ("scene", "program"), prepare)
}
