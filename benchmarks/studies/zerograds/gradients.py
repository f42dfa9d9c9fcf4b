"""Fig. 11: how much a gradient's length changes over a run; and whether it points the right way.

The paper plots the variance of the length and says that it tells nothing about correctness. So here
is also the cosine with the true gradient of the smoothed function at the same point and with the
sigma of that step: by thousands of samples, or fewer with local support where there is one. SPSA's
gradient is a difference along a diagonal with random signs. All three drive the same Adam.
Evaluations are steps times samples.
"""

from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float
from tqdm import trange

import smoothdiff as sd
from benchmarks import _registry
from benchmarks._cache import cached, fingerprint
from benchmarks._grid import Grid, Row, short
from benchmarks._summary import quarters
from benchmarks._task import Problem, Task
from benchmarks.methods import adam, zerograds
from benchmarks.studies.zerograds._runs import BUDGETS, SOURCE, Steps, curves, load, panels

TASKS = ("rocket10", "led")
WINDOWS = 20  # of a run: a variance and a cosine for each
TITLES = {"spsa": "SPSA", "fr22": "FR22", "ours": "Ours"}
TRUTH, TRUTH_OF_TERMS = 4096, 256  # samples of a true gradient; with support few are enough
BATCH = 512  # points at once, for the memory
ROWS = {
    "variance": "Variance of its length",
    "relative": "Variance / squared mean length",
    "cosine": "Cosine with the truth",
}


class Signs(sd.Gaussian):
    """Random signs instead of normal numbers: SPSA's directions."""

    def points(self, u, n):
        """As for every sampler of points."""
        return jnp.sign(u - 0.5), None


def kept_gradient() -> optax.GradientTransformation:
    """Changes nothing; its state is the last gradient."""
    init = lambda params: jax.tree.map(jnp.zeros_like, params)
    update = lambda updates, state, params=None: (updates, updates)
    return optax.GradientTransformation(init, update)


def solver(name: str, problem: Problem) -> Any:
    """A solver whose optimiser has the last gradient as `opt_state[0]`."""
    keep = lambda optim: optax.chain(kept_gradient(), optim)
    if name == "ours":
        return eqx.tree_at(
            lambda solver: solver.optimizer, zerograds.solver(problem), replace_fn=keep
        )
    found = adam.fr22_solver(problem, Signs if name == "spsa" else sd.Gaussian)
    return eqx.tree_at(lambda solver: solver.optim, found, replace_fn=keep)


def measure(starts: int, folder: Path, fresh: bool) -> dict[str, Any]:
    """Quartiles over the starts of what each window shows, by task and by gradient."""
    tasks: dict[str, Any] = {}
    for task_name in TASKS:
        task = load(task_name)
        middles = (np.arange(WINDOWS) + 0.5) / WINDOWS * BUDGETS[task_name]
        tasks[task_name] = {"evaluations": middles.tolist()}
        for name in TITLES:
            follow, runs = following(name, task), []
            for seed in trange(starts, desc=f"{task_name}: {name}", unit="run"):
                path = folder / task_name / f"gradient-{name}-{seed}.npz"
                runs.append(cached(path, _fingerprint(task, seed), partial(follow, seed), fresh))
            tasks[task_name][name] = {row: quarters([run[row] for run in runs]) for row in ROWS}
    return {"tasks": tasks}


def _fingerprint(task: Task, seed: int) -> str:
    """Changes when a run would: the code, the task, and where it starts."""
    losses = [float(task.problem.loss(y)) for y in (task.start(seed), task.score.reference)]
    code = SOURCE, _registry.method("fr22").source, Path(__file__).read_text()
    return fingerprint(*code, task.name, task.problem.budget, task.problem.sigma, losses)


def following(name: str, task: Task) -> Callable[[int], dict[str, list[float]]]:
    """From a seed to what the gradients of a run are in each window; compiled once for all."""
    steps = Steps(solver(name, task.problem), task.problem)
    ends = {round(steps.number * (window + 1) / WINDOWS) for window in range(WINDOWS)}
    length, true_gradient = jax.jit(jnp.linalg.norm), jax.jit(_true_gradient(task.problem))

    def follow(seed: int) -> dict[str, list[float]]:
        key, lengths = jax.random.key(seed), []
        found: dict[str, list[float]] = {row: [] for row in ROWS}
        points = pairwise(steps(task.start(seed), key))
        for done, ((y, _), (_, state)) in enumerate(points, start=1):
            gradient = state.opt_state[0]
            lengths.append(length(gradient))
            if done in ends:
                # ours are in units of the first batch's spread
                unit = float(state.fit.first_spread) if name == "ours" else 1.0
                scaled, lengths = unit * np.asarray(lengths, float), []
                mean, variance = float(scaled.mean()), float(scaled.var())
                other = jax.random.fold_in(key, len(found["cosine"]))
                truth = true_gradient(other, y, state.progress.sigma)
                found["variance"].append(variance)
                found["relative"].append(variance / mean**2 if mean > 0 else 0.0)
                found["cosine"].append(_cosine(gradient, truth))
        return found

    return follow


def _cosine(a: Array, b: Array) -> float:
    """Zero where one of them is."""
    product = float(jnp.linalg.norm(a) * jnp.linalg.norm(b))
    return float(jnp.vdot(a, b)) / product if product > 0 else 0.0


def _true_gradient(problem: Problem) -> Callable[..., Float[Array, " n"]]:
    """`(key, y, sigma)` to the gradient of the smoothed loss, by what has the least noise."""
    options: dict[str, Any]
    fun, options = problem.loss, {"num_samples": TRUTH, "batch_size": BATCH}
    if problem.terms is not None:
        fun, options = problem.terms, {"num_samples": TRUTH_OF_TERMS, "support": problem.support}
    return lambda key, y, sigma: sd.smooth_grad(fun, sigma, **options)(key, y)


def tables(results: dict[str, Any]) -> Iterator[Grid]:
    """The medians over a run."""
    rows = []
    for name, task in results["tasks"].items():
        for gradient, title in TITLES.items():
            medians = (short(float(np.median(task[gradient][row][1]))) for row in ROWS)
            rows.append(Row(f"{name}, {title}", tuple(medians)))
        rows[-1] = rows[-1]._replace(end=True)
    yield Grid(
        "Gradients over a run: medians over the windows and starts",
        f"{results['starts']} starts, {WINDOWS} windows.",
        ("task, gradient", *ROWS.values()),
        tuple(rows),
    )


def draw(results: dict[str, Any], path: Path) -> None:
    """A row for each of the three measures, a column for each task."""
    tasks = results["tasks"]
    cells = [(row, name) for row in ROWS for name in tasks]
    shown = {f"{name}: {ROWS[row].lower()}": (row, tasks[name]) for row, name in cells}
    with panels(path, shown, "Evaluations", "", abreast=len(tasks)) as axes:
        for axis, (row, task) in axes:
            axis.set_yscale("linear" if row == "cosine" else "log")
            found = {title: np.array(task[name][row], float) for name, title in TITLES.items()}
            if row != "cosine":  # a logarithm shows no zero
                found = {title: np.where(of > 0, of, np.nan) for title, of in found.items()}
            curves(axis, task["evaluations"], found)
