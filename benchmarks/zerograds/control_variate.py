"""How much the variance of a smoothed gradient falls with a surrogate as its control variate.

The paper descends on the surrogate, which is biased; taken off the function before it is sampled
and put back afterwards, the same surrogate leaves the estimate unbiased. Along a run of ours, the
gradient at the parameters of the time is estimated many times, with and without the surrogate of
the time, from equally many evaluations. Those of the run, which the surrogate has learnt from, come
on top. Both with the mean as a baseline and with the default, which is itself a fit to the samples.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from rich.table import Table
from tqdm import tqdm

import smoothdiff as sd
from benchmarks._style import COLOURS, figure
from benchmarks._task import Task
from benchmarks.zerograds import _configurations as configurations
from benchmarks.zerograds import _show
from benchmarks.zerograds._loop import Steps
from benchmarks.zerograds._setting import Setting, load

SHARES = (0.05, 0.25, 0.5, 1.0)  # of a run: where gradients are looked at
NUM_SAMPLES = 32  # evaluations of an estimate
Baseline = Literal["mean", "gp"]
BASELINES: dict[Baseline, str] = {"mean": "baseline: the mean", "gp": "the default, gp"}


def measure(setting: Setting, folder: Path, fresh: bool) -> dict[str, Any]:
    """Quartiles over the starts of how many times smaller the variance is, by task and baseline.

    It takes a minute or two, so nothing is kept.
    """
    found: dict[str, Any] = {}
    with tqdm(total=len(setting.control) * setting.gradient_seeds, unit="run") as bar:
        for name in setting.control:
            task, each = load(name, setting), []
            for seed in range(setting.gradient_seeds):
                bar.set_description(f"{name}: start {seed}, control variate")
                each.append(along(task, seed, setting.repeats))
                bar.update()
            found[name] = {"evaluations": [share * task.budget.evaluations for share in SHARES]}
            for baseline in BASELINES:
                ratios = [ratios[baseline] for ratios in each]
                found[name][baseline] = np.quantile(ratios, [0.25, 0.5, 0.75], axis=0).tolist()
    return {
        "starts": setting.gradient_seeds,
        "samples": NUM_SAMPLES,
        "repeats": setting.repeats,
        "tasks": found,
    }


def along(task: Task, seed: int, repeats: int) -> dict[str, list[float]]:
    """How many times smaller the variance is at several times of a run."""
    solver = configurations.ours(task)
    steps, key = Steps(solver, task), jax.random.key(seed)
    ratios = {name: jax.jit(_ratio(task, solver, name, repeats)) for name in BASELINES}
    y, done = task.start(seed), 0
    state = jax.jit(steps.init)(y, key)
    found = {name: [] for name in BASELINES}

    @jax.jit
    def advance(y, state, number):
        step = lambda _, carry: steps.step(carry[0], carry[1], key)
        return jax.lax.fori_loop(0, number, step, (y, state))

    for share in SHARES:
        end = round(share * steps.number)
        y, state = advance(y, state, end - done)
        done = end
        for name, ratio in ratios.items():
            # a key that no step of the run has had
            found[name].append(float(ratio(jax.random.fold_in(key, steps.number + end), y, state)))
    return found


def _ratio(task: Task, solver: sd.ZeroGrads, baseline: Baseline, repeats: int) -> Callable:
    """`(key, y, state)` to the variance without the surrogate over that with it."""

    def variance(transform: Callable, keys: Array, y: Array) -> Array:
        gradients = jax.lax.map(lambda key: transform(key, y), keys)
        return jnp.sum(jnp.var(gradients, axis=0))

    def ratio(key: Array, y: Array, state: Any) -> Array:
        options: Any = {"num_samples": NUM_SAMPLES, "baseline": baseline}
        learnt, keys = solver.learnt(state, y), jax.random.split(key, repeats)
        alone = sd.smooth_grad(task.loss, task.sigma, **options)
        helped = sd.control_variate(sd.smooth_grad, task.loss, learnt, task.sigma, **options)
        return variance(alone, keys, y) / variance(helped, keys, y)

    return ratio


def tables(results: dict[str, Any]) -> Table:
    """The medians."""
    shown = _show.table(
        "A surrogate as control variate: how many times smaller the variance of the gradient is",
        f"{results['samples']} evaluations an estimate, {results['repeats']} estimates, medians "
        f"over {results['starts']} starts, after so much of a run of ours.",
        "task",
        "baseline",
        *(f"{share:.0%}" for share in SHARES),
    )
    for name, task in results["tasks"].items():
        for baseline, title in BASELINES.items():
            shown.add_row(name, title, *(_show.times(ratio) for ratio in task[baseline][1]))
    return shown


def draw(results: dict[str, Any], folder: Path) -> None:
    """The ratios along the run, a panel for each task."""
    tasks = results["tasks"]
    size = (3.6 * len(tasks), 3.2)
    top = 1.1 * max(np.max(task[baseline]) for task in tasks.values() for baseline in BASELINES)
    with figure(folder / "control_variate.png", 1, len(tasks), size) as (drawn, axes):
        for axis, (name, task) in zip(axes[0], tasks.items(), strict=True):
            for (baseline, title), colour in zip(BASELINES.items(), COLOURS, strict=False):
                low, middle, high = np.array(task[baseline])
                axis.plot(task["evaluations"], middle, marker="o", color=colour, label=title)
                axis.fill_between(task["evaluations"], low, high, color=colour, alpha=0.15, lw=0)
            axis.axhline(1, color="0.4", lw=0.8, ls=":")
            axis.set(ylim=(0, top), xlabel="Evaluations of the run", title=name)
        axes[0, 0].set_ylabel("Variance without / with the surrogate")
        drawn.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
