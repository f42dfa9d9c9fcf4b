"""The same calls on the CPU and on JAX's accelerator, a GPU or TPU, if there is one.

Functions of JAX, which run where the estimates do. The first call compiles; of a solver it is a
whole run, and a later run is divided by its evaluations. What is slow has fewer turns.
"""

import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import smoothdiff as sd
from benchmarks._grid import Grid
from benchmarks._style import COLOURS, figure
from benchmarks._summary import quarters
from benchmarks.studies._devices import picture
from benchmarks.studies._listed import listed

HELP = "transforms, filters and solvers on a GPU or TPU against the CPU"
OPTIONS = ()
TURNS, LONGEST = 7, 2.0  # no further turn after so many seconds of them
SIGMA, SAMPLES = 0.1, (64, 1_024, 16_384)
MOST_ON_CPU = 1_024  # more samples of a picture take ten seconds a call
PARAMETERS = 1_000, 100_000, 1_000_000
RESIDUALS, SPACE = 10_000, (512, 512, 3)
CPU, ACCELERATOR = "CPU", "accelerator"


def rendered(y: jax.Array) -> jax.Array:
    """A number of dear pixels."""
    return jnp.mean(picture(y))


def stairs(y: jax.Array, args: Any = None) -> jax.Array:
    """A sum of steps."""
    return jnp.sum(jnp.floor(8 * (y - 1) ** 2))


def bent(y: jax.Array, design: jax.Array) -> jax.Array:
    """Residuals with small jumps."""
    along = jnp.matmul(design, y, precision="highest")
    return jnp.tanh(along - 1) + jnp.round(8 * jnp.sin(along)) / 80


def calls(device: str) -> dict[str, Callable[[], int]]:
    """What is timed there; each call gives the number of evaluations to divide by, or 1."""
    key, y = jax.random.key(0), jnp.array([2.0, 0.3, 0.5])
    found: dict[str, Callable[[], int]] = {}
    for transform, counts in (sd.smooth_grad, SAMPLES), (sd.smooth_hessian, SAMPLES[1:2]):
        for count in counts:
            if device != CPU or count <= MOST_ON_CPU:
                call = transform(rendered, SIGMA, num_samples=count)
                name = f"{transform.__name__}, picture, {count:,} samples"
                found[name] = compiled(call, key, y)
    for n in PARAMETERS:
        call = sd.smooth_grad(stairs, SIGMA, num_samples=SAMPLES[0])
        found[f"smooth_grad, {n:,} parameters"] = compiled(call, key, jnp.zeros(n))
    signal, guide = jax.random.normal(key, (2, *SPACE))
    found[f"bilateral filter, {SPACE[0]}²"] = compiled(
        sd.filters.bilateral(0.5, 3, ndim=2), signal, guide
    )
    design = jax.random.normal(key, (RESIDUALS, 10))
    for search, fun, n, args, most in (
        (sd.least_squares, bent, 10, design, 100),
        (sd.minimise, stairs, 5, None, 100),
        (sd.minimise, stairs, 10_000, None, 1_000),
    ):
        run = partial(search, fun, jnp.zeros(n), args, key=key, max_evaluations=most)
        found[f"{search.__name__}, {n:,} parameters"] = lambda run=run: run().evaluations
    return found


def compiled(function: Callable, *args: Any) -> Callable[[], int]:
    """A call of the function, as one program."""
    program = jax.jit(function)

    def call() -> int:
        jax.block_until_ready(program(*args))
        return 1

    return call


def timed(call: Callable[[], int]) -> dict[str, Any]:
    """Seconds of the first call, and quartiles of milliseconds of later ones."""
    seconds, each = [], []
    while len(each) < 2 or (len(each) <= TURNS and sum(seconds[1:]) < LONGEST):
        began = time.perf_counter()
        count = call()
        seconds.append(time.perf_counter() - began)
        each.append(1e3 * seconds[-1] / count)
    return {"first, s": seconds[0], "ms": quarters(each[1:])}


def measure(options: Namespace, folder: Path) -> dict[str, Any]:
    """Times of each call on each device."""
    devices = {CPU: jax.devices("cpu")[0]}
    if jax.devices()[0].platform != "cpu":
        devices = {ACCELERATOR: jax.devices()[0], **devices}  # which makes all of the calls
    found: dict[str, dict[str, Any]] = {}
    for where, device in devices.items():
        with jax.default_device(device):
            for name, call in tqdm(calls(where).items(), desc=where):
                found.setdefault(name, {})[where] = timed(call)
    kinds = {w: str(devices[w].device_kind) for w in (CPU, ACCELERATOR) if w in devices}
    return {"turns": TURNS, "devices": kinds, "calls": found}


def tables(results: dict[str, Any]) -> Iterator[Grid]:
    """A line for each call."""
    lines = []
    for name, found in results["calls"].items():
        line: dict[str, Any] = {"call": name}
        for where in results["devices"]:
            line |= {f"{where}: {k}": found.get(where, {}).get(k) for k in ("first, s", "ms")}
        if ACCELERATOR in results["devices"]:
            ms = {where: one["ms"][1] for where, one in found.items()}
            line["times as fast"] = ms[CPU] / ms[ACCELERATOR] if CPU in ms else None
        lines.append(line)
    there = results["devices"].get(ACCELERATOR)
    yield listed(
        f"On an accelerator, {there}" if there else "JAX has no accelerator here: the CPU alone",
        f"Medians [quartiles] of up to {results['turns']} calls, or of an evaluation in runs of "
        "solvers.",
        lines,
    )


def draw(results: dict[str, Any], folder: Path) -> None:
    """Bars of both devices."""
    names, devices = list(results["calls"]), list(results["devices"])
    with figure(folder / "accelerator.png", 1, 1, (8, 0.35 * len(names) + 1)) as (_, axes):
        axis, height = axes[0, 0], 0.8 / len(devices)
        for i, where in enumerate(devices):
            found = [results["calls"][name].get(where, {"ms": [np.nan] * 3}) for name in names]
            places = np.arange(len(names)) + (i - (len(devices) - 1) / 2) * height
            widths = [one["ms"][1] for one in found]
            axis.barh(places, widths, height, color=COLOURS[i], label=results["devices"][where])
        axis.set(xscale="log", xlabel="Milliseconds of a call, or of an evaluation of a solver")
        axis.set(yticks=range(len(names)), yticklabels=names, ylim=(len(names) - 0.4, -0.6))
        axis.legend()
