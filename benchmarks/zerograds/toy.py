"""Fig. 4: a surrogate learns a function of one parameter near the parameter, which follows it."""

from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from rich.table import Table
from scipy.special import ndtri

import smoothdiff as sd
from benchmarks._style import COLOURS, figure
from benchmarks._task import Budget, Task
from benchmarks.zerograds import _configurations as configurations
from benchmarks.zerograds import _show
from benchmarks.zerograds._loop import Steps
from benchmarks.zerograds._setting import PLENTY, Setting
from smoothdiff.surrogates import MLP

SHOWN = (0.0, 0.1, 0.35, 1.0)  # of the iterations, as in the paper
BUDGET, START, REFERENCE, SIGMA = 800, 0.18, 0.75, 0.1
LAST = 40  # samples that are drawn
NODES = ndtri((np.arange(1000) + 0.5) / 1000)  # of the quadrature that smooths
GRID = np.linspace(0, 1, 401)


def loss(y: np.ndarray) -> np.ndarray:
    """A staircase down to the reference, with a wide plateau and a dip that is no way out."""
    stairs = np.floor(12 * np.abs(y - REFERENCE)) / 12
    return np.minimum(stairs, 0.5) - np.where(np.abs(y - 0.46) < 0.015, 0.1, 0.0)


def smoothed(y: np.ndarray, sigma: float) -> np.ndarray:
    """The mean of the loss around a point, where it is bounded like the solver's samples."""
    return loss(np.clip(np.asarray(y)[..., None] + sigma * NODES, 0, 1)).mean(-1)


def task(seen: list[float]) -> Task:
    """The loss as a black box, which notes in `seen` where it was evaluated."""

    def watched(y: np.ndarray) -> np.ndarray:
        seen.append(float(y))
        return np.asarray(loss(y), np.float32)

    box = sd.black_box(watched, jax.ShapeDtypeStruct((), jnp.float32))
    return Task(
        name="toy",
        title="A staircase",
        loss=box,
        exact_loss=box,
        start=lambda seed: jnp.asarray(START, jnp.float32),
        reference=jnp.asarray(REFERENCE),
        bounds=(jnp.zeros(()), jnp.ones(())),
        sigma=SIGMA,
        budget=Budget(BUDGET, PLENTY),
        seeds=1,
    )


def measure(setting: Setting, folder: Path, fresh: bool) -> dict[str, Any]:
    """The parameter, its last samples and the surrogate, at some of the iterations.

    It takes seconds, so nothing is kept.
    """
    seen: list[float] = []
    problem = task(seen)
    surrogate = MLP(1, key=jax.random.key(1))
    steps = Steps(configurations.ours(problem, surrogate=surrogate), problem)
    y, key = problem.start(0), jax.random.key(0)
    state, step = jax.jit(steps.init)(y, key), jax.jit(steps.step)
    marks = {round(share * steps.number): share for share in SHOWN}
    frames = []
    for done in range(steps.number + 1):
        if done in marks:
            jax.block_until_ready(y)
            sigma = min(float(state.progress.sigma), SIGMA)  # infinite before the first step
            height = _height(surrogate, state.fit, float(y), sigma)
            frames.append(
                {
                    "share": marks[done],
                    "evaluations": len(seen),
                    "y": float(y),
                    "loss": float(loss(np.asarray(y))),
                    "sigma": sigma,
                    "smoothed": float(smoothed(np.asarray(y), sigma)),
                    "samples": seen[-LAST:],
                    "surrogate": height.tolist(),
                }
            )
        if done < steps.number:
            y, state = step(y, state, key)
    return {"reference": REFERENCE, "frames": frames}


def _height(surrogate: MLP, fit: Any, y: float, sigma: float) -> np.ndarray:
    """The surrogate on the grid, in units of the loss.

    It has learnt differences only, so it is drawn as high as the smoothed loss at the parameter.
    """
    learnt = eqx.combine(fit.weights, eqx.filter(surrogate, eqx.is_inexact_array, inverse=True))
    at = lambda points: (
        fit.spread * jax.vmap(learnt)((points[:, None] - fit.origin[None]) / fit.unit[None])
    )
    points = jnp.asarray(np.append(GRID, y), jnp.float32)
    heights = np.asarray(at(points), float)
    return heights[:-1] - heights[-1] + float(smoothed(np.asarray(y), sigma))


def tables(results: dict[str, Any]) -> Table:
    """Where the parameter is."""
    shown = _show.table(
        "Toy: a staircase with a wide plateau and a dip",
        f"The parameter that is sought is {results['reference']}.",
        "share of the iterations",
        "evaluations",
        "parameter",
        "loss",
        "smoothed loss",
    )
    for frame in results["frames"]:
        numbers = (f"{frame[name]:.3f}" for name in ("y", "loss", "smoothed"))
        shown.add_row(f"{frame['share']:.0%}", str(frame["evaluations"]), *numbers)
    return shown


def draw(results: dict[str, Any], folder: Path) -> None:
    """A panel for each of the iterations."""
    frames = results["frames"]
    top = 1.2 * loss(GRID).max()
    with figure(folder / "toy.png", 1, len(frames), (11, 3)) as (drawn, axes):
        for axis, frame in zip(axes[0], frames, strict=True):
            density = np.exp(-(((GRID - frame["y"]) / frame["sigma"]) ** 2) / 2)
            axis.fill_between(GRID, 0, 0.3 * top * density, color="0.85", lw=0, label="Locality")
            axis.plot(GRID, loss(GRID), color="0.2", lw=1, label="Loss")
            axis.plot(
                GRID, smoothed(GRID, frame["sigma"]), color="0.5", lw=1, ls="--", label="Smoothed"
            )
            near = np.abs(GRID - frame["y"]) < 2 * frame["sigma"]
            learnt = np.asarray(frame["surrogate"])
            axis.plot(GRID, learnt, color=COLOURS[1], lw=0.8)
            axis.plot(GRID[near], learnt[near], color=COLOURS[1], lw=2.4, label="Surrogate")
            samples = np.asarray(frame["samples"])
            axis.plot(samples, loss(samples), "|", color="0.2", ms=9, label="Last samples")
            axis.plot(frame["y"], frame["loss"], "o", ms=8, color=COLOURS[2], label="Parameter")
            axis.set(ylim=(-0.02, top), xlabel="Parameter")
            axis.set_title(f"{frame['share']:.0%}: {frame['evaluations']} evaluations")
        axes[0, 0].set_ylabel("Loss")
        drawn.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=6)
