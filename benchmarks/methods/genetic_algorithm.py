"""A genetic algorithm as in PyGAD, with its own defaults for selection, crossover and mutation.

The first population is the start and normal samples around it; mutations are up to sigma.
"""

import logging

import jax
import numpy as np

from benchmarks._task import NotAble, Solve, Task
from benchmarks.methods._flat import Flat, package

TITLE = "Genetic algorithm (PyGAD)"
POPULATION = 50
PARENTS = 10
MOST = 100_000  # parameters: PyGAD goes through them one by one
SILENT = logging.Logger("silent", logging.CRITICAL + 1)  # it would log how record ends a run


def prepare(task: Task) -> Solve:
    """Evaluates a whole generation in one call."""
    pygad = package("pygad", "pygad")
    flat = Flat(task)
    if flat.size > MOST:
        raise NotAble(f"takes minutes for a generation of more than {MOST} parameters")

    def solve(y0, key, record):
        seed = int(jax.random.randint(key, (), 1, 2**31 - 1))
        start = flat.start(y0)
        population = np.random.default_rng(seed).normal(start, task.sigma, (POPULATION, flat.size))
        population[0] = start
        lowest, shown = np.inf, y0

        def fitness(_, genes, indices):
            nonlocal lowest, shown
            values = np.asarray(flat.values(np.asarray(genes, flat.dtype)), float)
            if values.min() < lowest:
                lowest, shown = values.min(), flat.tree(genes[values.argmin()])
            return (-values).tolist()

        pygad.GA(
            num_generations=2**31,  # record ends it
            num_parents_mating=PARENTS,
            fitness_func=fitness,
            fitness_batch_size=POPULATION,
            initial_population=np.clip(population, flat.low, flat.high),
            random_mutation_min_val=-task.sigma,
            random_mutation_max_val=task.sigma,
            on_generation=lambda _: record(shown),
            random_seed=seed,
            suppress_warnings=True,
            logger=SILENT,
        ).run()

    return solve
