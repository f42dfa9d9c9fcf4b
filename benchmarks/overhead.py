"""What derivatives cost beyond the evaluations that they need, on Box10.

A gradient, a Hessian and a Hessian-vector product of N = 256 samples are timed against drawing the
same points and evaluating the function there. Both run in turn, and the ratio is taken pair by
pair, so that what else the machine does falls on both.
"""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

import smoothdiff as sd
from benchmarks._style import COLOURS, figure
from benchmarks._summary import machine
from benchmarks.tasks.boxes import BOX10_START, box10_loss

SAMPLES = 256
SIGMA = 0.1
PAIRS = 200
TARGET = 1.10
SAMPLER = sd.Gaussian()


def evaluate(key: jax.Array, y: jax.Array) -> jax.Array:
    """The function at the points that the transforms draw."""
    z, _ = SAMPLER.draw(key, 0, SAMPLES, SAMPLES, y.size, y.dtype)
    return jax.vmap(lambda z: box10_loss(y + SIGMA * z))(z)


def transforms() -> dict[str, Callable]:
    """What is timed, each as a function of key and y."""
    timed = {}
    for baseline in ("mean", "gp"):
        options: dict[str, Any] = {
            "num_samples": SAMPLES,
            "sampler": SAMPLER,
            "baseline": baseline,
        }
        hvp = sd.smooth_hvp(box10_loss, SIGMA, **options)
        timed[f"smooth_grad, {baseline}"] = sd.smooth_grad(box10_loss, SIGMA, **options)
        timed[f"smooth_hessian, {baseline}"] = sd.smooth_hessian(box10_loss, SIGMA, **options)
        timed[f"smooth_hvp, {baseline}"] = lambda key, y, hvp=hvp: hvp(key, y, jnp.ones_like(y))
    return timed


def time_pairs(first: Callable, second: Callable, pairs: int) -> np.ndarray:
    """Seconds of both, run in turn, (pairs, 2), compiled beforehand."""
    functions = [jax.jit(first), jax.jit(second)]
    y = jnp.asarray(BOX10_START)
    keys = jax.random.split(jax.random.key(0), pairs + 1)
    seconds = np.zeros((pairs + 1, 2))
    for i, key in enumerate(keys):
        for j in (0, 1) if i % 2 else (1, 0):  # neither always comes first
            began = time.perf_counter()
            jax.block_until_ready(functions[j](key, y))
            seconds[i, j] = time.perf_counter() - began
    return seconds[1:]  # the first pair compiles


def main(folder: Path, pairs: int = PAIRS) -> None:
    """Measures, prints a table, and writes results.json and overhead.png."""
    results = {}
    for name, transform in transforms().items():
        seconds = time_pairs(transform, evaluate, pairs)
        results[name] = {
            "ratio": np.quantile(seconds[:, 0] / seconds[:, 1], [0.25, 0.5, 0.75]).tolist(),
            "milliseconds": np.median(1e3 * seconds[:, 0]).item(),
            "milliseconds_of_evaluating": np.median(1e3 * seconds[:, 1]).item(),
        }
    folder.mkdir(parents=True, exist_ok=True)
    content = {
        "command": "python -m benchmarks overhead",
        "samples": SAMPLES,
        "pairs": pairs,
        "target": TARGET,
        "machine": machine(),
        "transforms": results,
    }
    (folder / "results.json").write_text(json.dumps(content, indent=1) + "\n")
    _draw(results, folder / "overhead.png")
    Console().print(_table(results, pairs))


def _table(results: dict[str, Any], pairs: int) -> Table:
    shown = Table(
        title=f"Box10, {SAMPLES} samples: time over evaluating at the same points",
        caption=f"Median \\[quartiles] of {pairs} pairs run in turn; target: at most {TARGET:.2f}.",
    )
    for column in ("transform", "ratio", "ms", "ms of evaluating"):
        shown.add_column(column, justify="left" if column == "transform" else "right")
    for name, found in results.items():
        low, middle, high = found["ratio"]
        shown.add_row(
            name,
            f"{middle:.3f} \\[{low:.3f}, {high:.3f}]",
            f"{found['milliseconds']:.2f}",
            f"{found['milliseconds_of_evaluating']:.2f}",
        )
    return shown


def _draw(results: dict[str, Any], path: Path) -> None:
    with figure(path, 1, 1, (5, 3.2)) as (_, axes):
        axis = axes[0, 0]
        ratios = np.array([found["ratio"] for found in results.values()])
        spread = np.abs(ratios[:, [0, 2]] - ratios[:, [1]]).T
        places = np.arange(len(ratios))
        axis.errorbar(ratios[:, 1], places, xerr=spread, fmt="o", color=COLOURS[1], capsize=3)
        axis.axvline(1, color="0.4", lw=0.8)
        axis.axvline(TARGET, color=COLOURS[0], lw=0.8, ls="--")
        axis.text(TARGET, len(ratios) - 0.6, f" target {TARGET:.2f}", color=COLOURS[0], fontsize=8)
        axis.set(yticks=places, yticklabels=list(results), xlabel="Time over evaluating alone")
        axis.set(xlim=(min(0.9, ratios.min() - 0.05), max(1.25, ratios.max() + 0.05)))
        axis.set(ylim=(len(ratios) - 0.4, -0.6))
