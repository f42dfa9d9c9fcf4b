"""Fig. 4: a surrogate learns a function of one parameter near the parameter, which follows it."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import ndtri

import smoothdiff as sd
from benchmarks._grid import Grid, Row
from benchmarks._style import COLOURS
from benchmarks._task import Budget, Problem
from benchmarks.methods import zerograds
from benchmarks.studies.zerograds._runs import PLENTY, Steps, panels
from smoothdiff.surrogates import MLP

SHOWN = (0.0, 0.1, 0.35, 1.0)  # of the iterations, as in the paper
BUDGET, START, REFERENCE, SIGMA = 800, 0.18, 0.75, 0.1
LAST = 40  # samples that are drawn
NODES = ndtri((np.arange(1000) + 0.5) / 1000)  # of the quadrature that smooths
GRID = np.linspace(0, 1, 401)  # where the loss is drawn
COARSE = np.linspace(0, 1, 40)  # where the surrogate is, which is smooth


def loss(y: Any) -> np.ndarray:
    """A staircase down to the reference, with a wide plateau and a dip that is no way out."""
    stairs = np.floor(12 * np.abs(y - REFERENCE)) / 12
    return np.minimum(stairs, 0.5) - np.where(np.abs(y - 0.46) < 0.015, 0.1, 0.0)


def smoothed(y: Any, sigma: float) -> np.ndarray:
    """The mean of the loss around a point, where it is bounded like the solver's samples."""
    return loss(np.clip(np.asarray(y)[..., None] + sigma * NODES, 0, 1)).mean(-1)


def measure(starts: int, folder: Path, fresh: bool) -> dict[str, Any]:
    """The parameter, its last samples and the surrogate, at some of the iterations.

    It takes seconds, so nothing is kept.
    """
    seen: list[float] = []

    def watched(y: np.ndarray) -> np.ndarray:
        seen.append(float(y))
        return np.asarray(loss(y), np.float32)

    problem = Problem(
        loss=sd.black_box(watched, jax.ShapeDtypeStruct((), jnp.float32)),
        bounds=(jnp.zeros(()), jnp.ones(())),
        sigma=SIGMA,
        budget=Budget(BUDGET, PLENTY),
    )
    solver = zerograds.solver(problem, surrogate=MLP(1, key=jax.random.key(1)))
    steps = Steps(solver, problem)
    along = steps.at(SHOWN, jnp.asarray(START, jnp.float32), jax.random.key(0))
    frames = []
    for share, (_, y, state) in zip(SHOWN, along, strict=True):
        at, sigma = float(y), min(float(state.progress.sigma), SIGMA)  # infinite at first
        learnt = jax.vmap(solver.learnt(state, y))
        heights = np.asarray(learnt(jnp.asarray([at, *COARSE], jnp.float32)), float)
        smooth = float(smoothed(at, sigma))
        frames.append(
            {
                "share": share,
                "evaluations": len(seen),
                "y": at,
                "loss": float(loss(at)),
                "sigma": sigma,
                "smoothed": smooth,
                "samples": seen[-LAST:],
                # it learns differences only, so it is as high as the smoothed loss at y
                "surrogate": (heights[1:] - heights[0] + smooth).tolist(),
            }
        )
    return {"reference": REFERENCE, "frames": frames}


def tables(results: dict[str, Any]) -> Iterator[Grid]:
    """Where the parameter is."""
    rows = []
    for frame in results["frames"]:
        values = (f"{frame[name]:.3f}" for name in ("y", "loss", "smoothed"))
        rows.append(Row(f"{frame['share']:.0%}", (str(frame["evaluations"]), *values)))
    yield Grid(
        "Toy: a staircase with a wide plateau and a dip",
        f"The parameter that is sought is {results['reference']}.",
        ("share of the iterations", "evaluations", "parameter", "loss", "smoothed loss"),
        tuple(rows),
    )


def draw(results: dict[str, Any], path: Path) -> None:
    """A panel for each of the iterations."""
    frames = {f"{f['share']:.0%}: {f['evaluations']} evaluations": f for f in results["frames"]}
    top = 1.2 * loss(GRID).max()
    with panels(path, frames, "Parameter", "Loss") as axes:
        for axis, frame in axes:
            y, sigma = frame["y"], frame["sigma"]
            density = np.exp(-(((GRID - y) / sigma) ** 2) / 2)
            axis.fill_between(GRID, 0, 0.3 * top * density, color="0.85", lw=0, label="Locality")
            axis.plot(GRID, loss(GRID), color="0.2", lw=1, label="Loss")
            axis.plot(GRID, smoothed(GRID, sigma), color="0.5", lw=1, ls="--", label="Smoothed")
            learnt = np.asarray(frame["surrogate"])
            at = np.linspace(0, 1, learnt.size)
            near = np.abs(at - y) < 2 * sigma
            axis.plot(at, learnt, color=COLOURS[1], lw=0.8)
            axis.plot(at[near], learnt[near], color=COLOURS[1], lw=2.4, label="Surrogate")
            samples = np.asarray(frame["samples"])
            axis.plot(samples, loss(samples), "|", color="0.2", ms=9, label="Last samples")
            axis.plot(y, frame["loss"], "o", ms=8, color=COLOURS[2], label="Parameter")
            axis.set_ylim(-0.02, top)
