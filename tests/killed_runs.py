"""Runs for processes that are killed, each kept as it goes. No tests here."""

import functools
import shutil
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest
import stripes as tiny

import smoothdiff as sd
from benchmarks import __main__ as cli
from benchmarks import _black_boxes

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


@functools.cache  # what is the same function is compiled once
def called(host: Any, squares: bool, shape: tuple[int, ...]) -> Any:
    """What a solver is given: residuals, or the sum of their squares."""
    box = sd.black_box(host, jax.ShapeDtypeStruct(shape, jnp.float32))
    return lambda y, args: box(y) if squares else jnp.sum(box(y) ** 2)


def run(name: str, folder: Path) -> None:
    """Makes the run, or goes on with it; writes down how many steps it made, and what it found."""
    solver, y0, host, most = RUNS[name]
    squares = isinstance(solver, optx.AbstractLeastSquaresSolver)
    fun = called(host, squares, np.shape(host(y0)))
    bounds = (-1.0, 2.0) if solver.__class__ is not sd.ZeroGrads else None
    limits = {"max_evaluations": most, "bounds": bounds, "key": jax.random.key(0)}
    made: list[int] = []
    (folder / "begun").touch()
    call = sd.least_squares if squares else sd.minimise
    result = call(
        fun,
        jnp.asarray(y0),
        solver=solver,
        checkpoint=folder / "run.npz",
        callback=lambda record: made.append(record.step),
        **limits,
    )
    (folder / "made").write_text(str(len(made)))
    found = [np.asarray(result.fun), np.asarray(result.y), np.asarray(result.evaluations)]
    found += [np.asarray(record.y) for record in result.history]
    found += [np.asarray(record.fun) for record in result.history]
    write(folder, b"".join(part.tobytes() for part in found))


def write(folder: Path, found: bytes) -> None:
    """All of it or nothing."""
    (folder / "found.part").write_bytes(found)
    (folder / "found.part").rename(folder / "found")


def slowly(problem: Any) -> Any:
    """A method of the benchmarks that takes a while, to be killed in."""
    solve = tiny.halving(problem)

    def waiting(y0: Any, key: Any, record: Any) -> None:
        def recorded(y: Any) -> None:
            time.sleep(0.02)
            record(y)

        solve(y0, key, recorded)

    return waiting


def benchmarks(folder: Path) -> None:
    """Runs two methods of the benchmarks, or goes on; writes what they found, without times.

    Nothing is drawn, which is done anew in any case and takes much longer.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_black_boxes, "draw", lambda results, folder: None)
        patch.setattr(cli, "_page", lambda names, runs: None)
        tiny.registered(patch, methods={"halving": tiny.halving, "slowly": slowly})
        (folder / "begun").touch()
        cli.main(["run", "all"], folder)
    found = b""
    for path in sorted(folder.glob("stripes/raw/*/*.npz")):
        with np.load(path) as kept:
            names = sorted(set(kept) - {"seconds", "json"})
            found += b"".join(kept[name].tobytes() for name in names)
    write(folder, found)


def again_and_again(name: str, folder: Path) -> None:
    """A run for whoever stops this process at times and copies what there is; then these copies.

    All has been compiled before, so that little of the time goes into anything else.
    """
    make = benchmarks if name == "benchmarks" else functools.partial(run, name)
    for warm in ("first", "whole"):
        (folder / warm).mkdir()
        make(folder / warm)
    running = folder / "running"
    while not (folder / "enough").exists():
        shutil.rmtree(running, ignore_errors=True)
        running.mkdir()
        make(running)
    for left in sorted(folder.glob("left*")):
        make(left)
