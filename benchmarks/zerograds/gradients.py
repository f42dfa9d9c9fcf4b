"""Fig. 11: how much a gradient's length changes over a run; and whether it points the right way.

The paper plots the variance of the length and says that it tells nothing about correctness. So here
is also the cosine with the true gradient of the smoothed function at the same point and with the
sigma of that step: by thousands of samples, with local support where there is one, or by AD where
the function is smooth. SPSA's gradient is a difference along a diagonal with random signs. All
three drive the same Adam. Evaluations are steps times samples.
"""

import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float
from rich.table import Table
from tqdm import tqdm

import smoothdiff as sd
from benchmarks._style import COLOURS, figure
from benchmarks._task import Task
from benchmarks.zerograds import _configurations as configurations
from benchmarks.zerograds import _show
from benchmarks.zerograds._loop import Steps
from benchmarks.zerograds._setting import Setting, load

WINDOWS = 20  # of a run: a variance and a cosine for each
TITLES = {"spsa": "SPSA", "fr22": "FR22", "ours": "Ours"}
SMOOTH = ("mlp",)  # their AD gives true gradients
BY_AD, BY_TERMS = 64, 256  # samples, enough for hardly any noise
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
    return optax.GradientTransformation(
        init, lambda updates, state, params=None: (updates, updates)
    )


def solver(name: str, task: Task) -> Any:
    """A solver whose optimiser has the last gradient as `opt_state[0]`."""
    if name == "ours":
        return configurations.ours(task, before=kept_gradient())
    sampler = (Signs if name == "spsa" else sd.Gaussian)(antithetic=True)
    return configurations.smoothed_gradient(task, before=kept_gradient(), sampler=sampler)


class Descent:
    """A solver on a task, compiled window by window."""

    def __init__(self, name: str, task: Task, truth: int):
        self._name, self._task, self._num_samples = name, task, truth
        self._steps = Steps(solver(name, task), task)
        self._init, self._window = jax.jit(self._steps.init), jax.jit(self._advance)
        self._truth = jax.jit(_true_gradient(task, truth))

    def fingerprint(self, seed: int) -> str:
        """Changes when the run would: the code, the task, and where it starts."""
        task, y = self._task, self._task.start(seed)
        losses = [float(task.loss(at)) for at in (y, task.reference)]
        inputs = repr((task.name, task.budget, task.sigma, losses, self._name, self._num_samples))
        texts = (configurations.SOURCE, Path(__file__).read_text(), inputs)
        return hashlib.sha256("\0".join(texts).encode()).hexdigest()[:16]

    def _advance(self, y, state, key):
        """A window: y and state after it, where its last gradient was, the lengths of all."""

        def step(carry, _):
            y, state, _ = carry
            new_y, state = self._steps.step(y, state, key)
            return (new_y, state, y), jnp.linalg.norm(state.opt_state[0])

        number = self._steps.number // WINDOWS
        (y, state, before), lengths = jax.lax.scan(step, (y, state, y), length=number)
        return y, state, before, lengths

    def __call__(self, seed: int) -> dict[str, list[float]]:
        """Variance of the lengths in each window, the same over their squared mean, a cosine."""
        y, key = self._task.start(seed), jax.random.key(seed)
        state = self._init(y, key)
        found: dict[str, list[float]] = {row: [] for row in ROWS}
        for window in range(WINDOWS):
            y, state, before, lengths = self._window(y, state, key)
            lengths = np.asarray(lengths, float) * _unit(state)
            truth = self._truth(jax.random.fold_in(key, window), before, state.progress.sigma)
            mean = lengths.mean()
            found["variance"].append(lengths.var())
            found["relative"].append(lengths.var() / mean**2 if mean > 0 else 0.0)
            found["cosine"].append(_cosine(state.opt_state[0], truth))
        return found


def _unit(state: Any) -> float:
    """What a gradient is given in: ours in units of the first batch's spread."""
    return float(state.fit.first_spread) if hasattr(state, "fit") else 1.0


def _cosine(a: Array, b: Array) -> float:
    """Zero where one of them is."""
    product = float(jnp.linalg.norm(a) * jnp.linalg.norm(b))
    return float(jnp.vdot(a, b)) / product if product > 0 else 0.0


def _true_gradient(task: Task, num_samples: int) -> Callable[..., Float[Array, " n"]]:
    """`(key, y, sigma)` to the gradient of the smoothed loss, by what has the least noise."""

    def by_ad(key, y, sigma):
        slope = lambda key: jax.grad(task.loss)(y + sigma * jax.random.normal(key, y.shape))
        return jnp.mean(jax.lax.map(slope, jax.random.split(key, BY_AD)), axis=0)

    def by_values(fun, **options):
        return lambda key, y, sigma: sd.smooth_grad(fun, sigma, **options)(key, y)

    if task.name in SMOOTH:
        return by_ad
    if task.terms is None:
        return by_values(task.loss, num_samples=num_samples, batch_size=BATCH)
    few = min(num_samples, BY_TERMS)
    return by_values(task.terms, num_samples=few, support=task.support)


def measure(setting: Setting, folder: Path, fresh: bool) -> dict[str, Any]:
    """Quartiles over the starts of what each window shows, by task and by gradient."""
    found: dict[str, Any] = {}
    total = len(setting.gradients) * len(TITLES) * setting.gradient_seeds
    with tqdm(total=total, unit="run") as bar:
        for task_name in setting.gradients:
            task = load(task_name, setting)
            found[task_name] = {"evaluations": _middles(task)}
            for name in TITLES:
                descent, runs = Descent(name, task, setting.truth), []
                for seed in range(setting.gradient_seeds):
                    bar.set_description(f"{task_name}: start {seed}, {name}")
                    path = folder / "runs" / task_name / f"gradient-{name}-{seed}.json"
                    runs.append(_kept(path, descent, seed, fresh))
                    bar.update()
                found[task_name][name] = {row: _quartiles(runs, row) for row in ROWS}
    return {"starts": setting.gradient_seeds, "titles": TITLES, "tasks": found}


def _kept(path: Path, descent: Descent, seed: int, fresh: bool) -> dict[str, list[float]]:
    """A run from its file, if that is of the same program, else made and written."""
    fingerprint = descent.fingerprint(seed)
    if path.exists() and not fresh:
        kept = json.loads(path.read_text())
        if kept.pop("fingerprint") == fingerprint:
            return kept
    found = descent(seed)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps({"fingerprint": fingerprint} | found))
    os.replace(temporary, path)  # all or nothing
    return found


def _quartiles(runs: list[dict[str, list[float]]], row: str) -> list[list[float]]:
    return np.quantile([run[row] for run in runs], [0.25, 0.5, 0.75], axis=0).tolist()


def _middles(task: Task) -> list[float]:
    """The evaluations in the middle of each window."""
    return ((np.arange(WINDOWS) + 0.5) / WINDOWS * task.budget.evaluations).tolist()


def tables(results: dict[str, Any]) -> Table:
    """The medians over a run."""
    shown = _show.table(
        "Gradients over a run: medians over the windows and starts",
        f"{results['starts']} starts, {WINDOWS} windows.",
        "task",
        "gradient",
        *ROWS.values(),
    )
    for name, task in results["tasks"].items():
        for gradient, title in results["titles"].items():
            medians = [float(np.median(task[gradient][row][1])) for row in ROWS]
            last = gradient == list(results["titles"])[-1]
            shown.add_row(name, title, *(f"{m:.2g}" for m in medians), end_section=last)
    return shown


def draw(results: dict[str, Any], folder: Path) -> None:
    """A row for each of the three measures, a column for each task."""
    tasks = results["tasks"]
    size = (3.3 * len(tasks) + 0.5, 7)
    with figure(folder / "gradients.png", len(ROWS), len(tasks), size) as (drawn, axes):
        for column, (name, task) in zip(axes.T, tasks.items(), strict=True):
            column[0].set_title(name)
            column[-1].set_xlabel("Evaluations")
            for axis, row in zip(column, ROWS, strict=True):
                for (gradient, title), colour in zip(TITLES.items(), COLOURS, strict=False):
                    x, (low, middle, high) = task["evaluations"], np.array(task[gradient][row])
                    axis.plot(x, middle, color=colour, label=title)
                    shown = (low > 0) | (row == "cosine")
                    axis.fill_between(x, low, high, shown, color=colour, alpha=0.15, lw=0)
                if row != "cosine" and any(np.max(task[name][row]) > 0 for name in TITLES):
                    axis.set_yscale("log", nonpositive="mask")
        for axis, title in zip(axes[:, 0], ROWS.values(), strict=True):
            axis.set_ylabel(title)
        drawn.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
