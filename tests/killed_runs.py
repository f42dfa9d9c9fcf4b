"""Runs for processes that are killed, each with a checkpoint. No tests here."""

import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx

import smoothdiff as sd

HIDDEN = np.linspace(0.2, 0.8, 144).reshape(12, 12)


def stairs(y: np.ndarray) -> np.ndarray:
    """Residuals of few parameters, in steps; each takes a while, to be killed in."""
    time.sleep(0.002)
    y = y.astype(np.float64)
    return np.floor(64 * np.array([2 * (y[1] - y[0] ** 2), 1 - y[0], y[2]])).astype(np.float32) / 64


def picture(y: np.ndarray) -> np.ndarray:
    """Residuals of many parameters, one each."""
    time.sleep(0.001)
    return np.floor(16 * (y - HIDDEN)).astype(np.float32) / 16


FEW, MANY = np.array([-0.5, 0.5, 0.3], np.float32), np.full((12, 12), 0.5, np.float32)
LOCAL = sd.local_support(1)
# the solver, where it starts, what it minimises, and at how many evaluations
RUNS: dict[str, tuple[Any, np.ndarray, Any, int]] = {
    "GaussNewton": (sd.GaussNewton(0.2, restarts=9), FEW, stairs, 150),
    "NewtonCG": (sd.NewtonCG(0.2, restarts=9), FEW, stairs, 150),
    "FirstOrder": (sd.FirstOrder(optax.adam(0.05), 0.2), FEW, stairs, 300),
    "ZeroGrads": (sd.ZeroGrads(0.2), FEW, stairs, 150),
    "GaussNewton of many": (sd.GaussNewton(0.1), MANY, picture, 300),
    "LocalGaussNewton": (sd.LocalGaussNewton(0.1, LOCAL), MANY, picture, 300),
    "LocalCrossEntropy": (sd.LocalCrossEntropy(LOCAL), MANY, picture, 300),
}


def run(name: str, folder: Path) -> None:
    """Makes the run, or goes on with it, and writes down what it found."""
    solver, y0, host, most = RUNS[name]
    box = sd.black_box(host, jax.ShapeDtypeStruct(np.shape(host(y0)), jnp.float32))
    squares = isinstance(solver, optx.AbstractLeastSquaresSolver)
    fun = lambda y, args: box(y) if squares else jnp.sum(box(y) ** 2)
    bounds = (-1.0, 2.0) if solver.__class__ is not sd.ZeroGrads else None
    limits = {"max_evaluations": most, "bounds": bounds, "key": jax.random.key(0)}
    (folder / "begun").touch()
    call = sd.least_squares if squares else sd.minimise
    result = call(fun, jnp.asarray(y0), solver=solver, checkpoint=folder / "run.npz", **limits)
    found = [np.asarray(result.fun), np.asarray(result.y), np.asarray(result.evaluations)]
    found += [np.asarray(record.y) for record in result.history]
    found += [np.asarray(record.fun) for record in result.history]
    (folder / "found.part").write_bytes(b"".join(part.tobytes() for part in found))
    (folder / "found.part").rename(folder / "found")
