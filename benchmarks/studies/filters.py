"""Time of the filters on grids against the memory traffic that they cannot do without.

The floor of a pass of `cross_bilateral` reads signal and guide and writes the signal; that of
`laplacian` reads and writes the signal once. Both are divided by the highest bandwidth of a copy at
any of the sizes: some copies wait for fresh pages of memory. Beside it stands the time of the
exponentials of a pass, one for each tap, alone.
"""

import math
from argparse import Namespace
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks._grid import Grid
from benchmarks._summary import quarters
from benchmarks._timing import compiled
from benchmarks.studies._listed import dots, listed
from smoothdiff import filters

HELP = "time of filters against moving their bytes"
OPTIONS = ()
SPACES = {"512²": (512, 512), "2048²": (2048, 2048), "64³": (64, 64, 64), "128³": (128, 128, 128)}
CHANNELS = (1, 3)
LEVELS = 3
TURNS = 15
TARGET = 4.0
MOVED = {"cross_bilateral": 3 * LEVELS, "laplacian": 2}  # how often an array is read or written


def functions(ndim: int) -> dict[str, Callable]:
    """What is timed, each as a function of signal and guide."""
    taps = 3**ndim - 1
    return {
        "copy": lambda signal, guide: signal + 1,
        "exponentials": lambda signal, guide: sum(jnp.exp(-signal * k) for k in range(1, taps + 1)),
        "cross_bilateral": filters.cross_bilateral(0.5, LEVELS, ndim=ndim),
        "laplacian": filters.laplacian(3.0, ndim=ndim),
    }


def seconds(space: tuple[int, ...], channels: int) -> dict[str, np.ndarray]:
    """Seconds of each function in each turn."""
    both = tuple(jax.random.normal(jax.random.key(0), (2, *space, channels)))
    return compiled(functions(len(space)), lambda _: both, TURNS)


def measure(options: Namespace, folder: Path) -> dict[str, Any]:
    """Times, floors and their ratios, for each size and filter."""
    timed = {
        f"{name}, {channels} channel{'s' if channels > 1 else ''}": (
            4 * math.prod(space) * channels,
            seconds(space, channels),
        )
        for name, space in SPACES.items()
        for channels in CHANNELS
    }
    bandwidth = {size: 2 * traffic / np.median(s["copy"]) for size, (traffic, s) in timed.items()}
    lines = []
    for size, (traffic, found) in timed.items():
        exponentials = 1e3 * LEVELS * np.median(found["exponentials"]).item()
        for name, moved in MOVED.items():
            floor = moved * traffic / max(bandwidth.values())
            lines.append(
                {
                    "size": size,
                    "filter": name,
                    "GB/s": 1e-9 * float(bandwidth[size]),
                    "ratio": quarters(found[name] / floor),
                    "ms": 1e3 * np.median(found[name]).item(),
                    "ms of floor": 1e3 * float(floor),
                    "ms of exponentials": exponentials if name == "cross_bilateral" else None,
                }
            )
    device = str(jax.devices()[0].device_kind)
    return {"levels": LEVELS, "turns": TURNS, "target": TARGET, "device": device, "lines": lines}


def tables(results: dict[str, Any]) -> Iterator[Grid]:
    """A line for each size and filter."""
    yield listed(
        f"Filters on grids, cross_bilateral with {results['levels']} levels: over memory traffic",
        f"Median [quartiles] of {results['turns']} turns; target: at most {results['target']:.0f}.",
        results["lines"],
    )


def draw(results: dict[str, Any], folder: Path) -> None:
    """Ratios with their quartiles."""
    rows = {f"{line['filter']}, {line['size']}": line["ratio"] for line in results["lines"]}
    label = "Time over that of moving the bytes; the target is a line"
    dots(folder / "filters.png", rows, results["target"], label, (1, 300))
