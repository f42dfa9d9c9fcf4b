"""How much the variance of a smoothed gradient falls with a surrogate as its control variate.

The paper descends on the surrogate, which is biased; taken off the function before it is sampled
and put back afterwards, the same surrogate leaves the estimate unbiased. Along a run of ours, the
gradient at the parameters of the time is estimated many times, with and without the surrogate of
the time, at the sigma of the time, from equally many evaluations. Those of the run, which the
surrogate has learnt from, come on top. Both with the mean as a baseline and with the default, which
is itself a fit to the samples.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array
from tqdm import trange

import smoothdiff as sd
from benchmarks._grid import Grid, Row, short
from benchmarks._summary import quarters
from benchmarks._task import Problem, Task
from benchmarks.methods import zerograds
from benchmarks.studies.zerograds._runs import BUDGETS, Steps, curves, load, panels

TASKS = ("rocket10", "led")
SHARES = (0.05, 0.25, 0.5, 1.0)  # of a run: where gradients are looked at
NUM_SAMPLES = 32  # evaluations of an estimate
REPEATS = 100  # estimates of which a variance is taken
BASELINES = {"mean": "baseline: the mean", "gp": "the default, gp"}


def measure(starts: int, folder: Path, fresh: bool) -> dict[str, Any]:
    """Quartiles over the starts of how many times smaller the variance is, by task and baseline.

    It takes a minute or two, so nothing is kept.
    """
    tasks = {}
    for name in TASKS:
        task, bar = load(name), trange(starts, desc=f"{name}: control variate", unit="run")
        runs = [along(task, seed) for seed in bar]
        tasks[name] = {"evaluations": [share * BUDGETS[name] for share in SHARES]}
        tasks[name] |= {each: quarters([run[each] for run in runs]) for each in BASELINES}
    return {"samples": NUM_SAMPLES, "repeats": REPEATS, "tasks": tasks}


def along(task: Task, seed: int) -> dict[str, list[float]]:
    """How many times smaller the variance is at several times of a run."""
    solver = zerograds.solver(task.problem)
    steps, key = Steps(solver, task.problem), jax.random.key(seed)
    ratios = {name: jax.jit(_ratio(task.problem, solver, name)) for name in BASELINES}
    found: dict[str, list[float]] = {name: [] for name in BASELINES}
    for done, y, state in steps.at(SHARES, task.start(seed), key):
        unused = jax.random.fold_in(key, steps.number + done)  # by the steps of the run
        for name, ratio in ratios.items():
            found[name].append(float(ratio(unused, y, state)))
    return found


def _ratio(problem: Problem, solver: sd.ZeroGrads, baseline: str) -> Callable[..., Array]:
    """`(key, y, state)` to the variance without the surrogate over that with it."""
    options: Any = {"num_samples": NUM_SAMPLES, "baseline": baseline}

    def ratio(key: Array, y: Array, state: Any) -> Array:
        def variance(gradient: Callable) -> Array:
            each = jax.lax.map(lambda key: gradient(key, y), jax.random.split(key, REPEATS))
            return jnp.sum(jnp.var(each, axis=0))

        # what is learnt is the function as it was sampled, at the sigma of that step
        sigma = state.progress.sigma
        helped = sd.control_variate(
            sd.smooth_grad, problem.loss, solver.learnt(state, y), sigma, **options
        )
        return variance(sd.smooth_grad(problem.loss, sigma, **options)) / variance(helped)

    return ratio


def tables(results: dict[str, Any]) -> Iterator[Grid]:
    """The medians."""
    rows = (
        Row(f"{name}, {title}", tuple(map(short, task[baseline][1])))
        for name, task in results["tasks"].items()
        for baseline, title in BASELINES.items()
    )
    yield Grid(
        "Control variate: how many times smaller a surrogate makes the gradient's variance",
        f"{results['samples']} evaluations an estimate, {results['repeats']} estimates, medians "
        f"over {results['starts']} starts, after so much of a run of ours.",
        ("task, baseline", *(f"{share:.0%}" for share in SHARES)),
        tuple(rows),
    )


def draw(results: dict[str, Any], path: Path) -> None:
    """The ratios along the run, a panel for each task."""
    ratio = "Variance without / with it"
    with panels(path, results["tasks"], "Evaluations of the run", ratio) as axes:
        for axis, task in axes:
            found = {shown: task[baseline] for baseline, shown in BASELINES.items()}
            curves(axis, task["evaluations"], found, marker="o")
            axis.axhline(1, color="0.4", lw=0.8, ls=":")
            axis.set_ylim(0)
