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
from benchmarks._style import COLOURS, figure
from benchmarks._timing import in_turns
from benchmarks.studies._listed import listed
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
    signal, guide = jax.random.normal(jax.random.key(0), (2, *space, channels))
    jitted = {name: jax.jit(fun) for name, fun in functions(len(space)).items()}
    calls = {name: lambda _, fun=fun: fun(signal, guide) for name, fun in jitted.items()}
    return in_turns(calls, TURNS)


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
                    "ratio": np.quantile(found[name] / floor, [0.25, 0.5, 0.75]).tolist(),
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
    """Times beside what moving the bytes takes, a panel for each filter."""
    target = results["target"]
    mark: dict[str, Any] = {"marker": "|", "ls": "", "ms": 12}
    with figure(folder / "filters.png", 1, 2, (8, 3.6)) as (drawn, axes):
        for axis, name, colour in zip(axes[0], MOVED, COLOURS, strict=False):
            lines = [line for line in results["lines"] if line["filter"] == name]
            column = lambda key, lines=lines: np.array([line[key] for line in lines], float)
            times, floors, places = column("ms"), column("ms of floor"), np.arange(len(lines))
            axis.hlines(places, floors, times, color="0.8", lw=2, zorder=1)
            axis.plot(floors, places, **mark, mew=2, color="0.4", label="memory traffic")
            axis.plot(target * floors, places, **mark, color="0.7", label=f"{target:.0f} times")
            alone = column("ms of exponentials")  # of one filter; else NaN, which is not drawn
            axis.plot(alone, places, "x", color=COLOURS[2], label="exponentials alone")
            axis.plot(times, places, "o", color=colour, label="filter")
            axis.set(xscale="log", xlabel="Milliseconds", title=name, yticks=places)
            axis.set_yticklabels([line["size"] for line in lines] if axis is axes[0, 0] else [])
            axis.invert_yaxis()
        drawn.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
