"""What derivatives cost beyond the evaluations that they need, on Box10.

A gradient, a Hessian and a Hessian-vector product of N = 256 samples are timed against drawing the
same points and evaluating the function there, and the ratio is taken turn by turn. Then what a run
of a solver costs before its function does: CPU seconds to the first steps, and of a second call.
"""

from argparse import Namespace
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import smoothdiff as sd
from benchmarks._grid import Grid
from benchmarks._summary import quarters
from benchmarks._timing import compiled
from benchmarks.studies import _startup
from benchmarks.studies._listed import dots, listed
from benchmarks.tasks.boxes import BOX10_START, box10_loss

HELP = "derivatives against evaluating at the same points, and what a run costs before its function"
OPTIONS = ()
SAMPLES = 256
SIGMA = 0.1
TURNS = 200
TARGET = 1.10
SAMPLER = sd.Gaussian()


def evaluating(fun: Callable, sigma: float, sampler: Any, num: int) -> Callable:
    """(key, y) -> the function at the points that the transforms draw."""

    def evaluate(key: Array, y: Array) -> Array:
        z, _ = sampler.draw(key, 0, num, num, y.size, y.dtype)
        return jax.vmap(lambda z: fun(y + sigma * z))(z)

    return evaluate


def transforms() -> dict[str, Callable]:
    """What is timed, each as a function of key and y."""
    timed = {}
    for baseline in ("mean", "gp"):
        options: Any = {"num_samples": SAMPLES, "sampler": SAMPLER, "baseline": baseline}
        hvp = sd.smooth_hvp(box10_loss, SIGMA, **options)
        timed[f"smooth_grad, {baseline}"] = sd.smooth_grad(box10_loss, SIGMA, **options)
        timed[f"smooth_hessian, {baseline}"] = sd.smooth_hessian(box10_loss, SIGMA, **options)
        timed[f"smooth_hvp, {baseline}"] = lambda key, y, hvp=hvp: hvp(key, y, jnp.ones_like(y))
    return timed


def measure(options: Namespace, folder: Path) -> dict[str, Any]:
    """Ratios and times of each transform."""
    y, keys = jnp.asarray(BOX10_START), list(jax.random.split(jax.random.key(0), TURNS + 1))
    alone = evaluating(box10_loss, SIGMA, SAMPLER, SAMPLES)
    lines = []
    for name, transform in transforms().items():
        calls = {"ours": transform, "alone": alone}
        ours, evaluations = compiled(calls, lambda i: (keys[i], y), TURNS).values()
        lines.append(
            {
                "transform": name,
                "ratio": quarters(ours / evaluations),
                "ms": 1e3 * np.median(ours).item(),
                "ms of evaluating": 1e3 * np.median(evaluations).item(),
            }
        )
    startup = _startup.measured()
    return {
        "samples": SAMPLES,
        "turns": TURNS,
        "target": TARGET,
        "lines": lines,
        "startup": startup,
    }


def tables(results: dict[str, Any]) -> Iterator[Grid]:
    """A line for each transform."""
    yield listed(
        f"Box10, {results['samples']} samples: time over evaluating at the same points",
        f"Median [quartiles] of {results['turns']} turns; target: at most {results['target']:.2f}.",
        results["lines"],
    )
    yield listed(
        f"{_startup.PARAMETERS} parameters, {_startup.RESIDUALS} residuals: CPU seconds to a step",
        f"Of a NumPy function; medians of {_startup.PROCESSES} processes. At most 2 s to "
        "the first step are aimed at, and 0.1 s again.",
        results["startup"],
    )


def draw(results: dict[str, Any], folder: Path) -> None:
    """Ratios with their quartiles."""
    rows = {line["transform"]: line["ratio"] for line in results["lines"]}
    path, label = folder / "overhead.png", "Time over evaluating alone; the target is a line"
    dots(path, rows, results["target"], label, (0.8, 2))
