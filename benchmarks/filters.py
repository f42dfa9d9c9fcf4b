"""Time of the filters on grids against the memory traffic that they cannot do without.

The floor of a pass of `cross_bilateral` reads signal and guide and writes the signal; that of
`laplacian` reads and writes the signal once. Both are divided by the highest bandwidth of a copy at
any of the sizes: some copies wait for fresh pages of memory. Beside it stands the time of the
exponentials of a pass, one for each tap, alone.
"""

import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks._style import COLOURS, figure
from benchmarks._summary import machine
from smoothdiff import filters

SPACES = {"512²": (512, 512), "2048²": (2048, 2048), "64³": (64, 64, 64), "128³": (128, 128, 128)}
CHANNELS = (1, 3)
LEVELS = 3
TURNS = 15
TARGET = 4.0
NAMES = ("cross_bilateral", "laplacian")


def functions(ndim: int) -> dict[str, Callable]:
    """What is timed, each as a function of signal and guide."""
    taps = 3**ndim - 1
    return {
        "copy": lambda signal, guide: signal + 1,
        "exponentials": lambda signal, guide: sum(jnp.exp(-signal * k) for k in range(1, taps + 1)),
        "cross_bilateral": filters.cross_bilateral(0.5, LEVELS, ndim=ndim),
        "laplacian": filters.laplacian(3.0, ndim=ndim),
    }


def time_turns(space: tuple[int, ...], channels: int, turns: int) -> dict[str, np.ndarray]:
    """Seconds of each function in each turn, compiled beforehand."""
    signal, guide = jax.random.normal(jax.random.key(0), (2, *space, channels))
    timed = {name: jax.jit(fun) for name, fun in functions(len(space)).items()}
    seconds = {name: np.zeros(turns + 1) for name in timed}
    for turn in range(turns + 1):
        for name, fun in timed.items():
            began = time.perf_counter()
            jax.block_until_ready(fun(signal, guide))
            seconds[name][turn] = time.perf_counter() - began
    return {name: found[1:] for name, found in seconds.items()}  # the first turn compiles


def bandwidth(seconds: dict[str, np.ndarray], traffic: int) -> float:
    """Bytes a second that a copy reads and writes."""
    return 2 * traffic / np.median(seconds["copy"]).item()


def compare(seconds: dict[str, np.ndarray], traffic: int, fastest: float) -> dict[str, Any]:
    """Floors, times and their ratios, for arrays of `traffic` bytes."""
    needed = {"cross_bilateral": 3 * LEVELS * traffic, "laplacian": 2 * traffic}
    found: dict[str, Any] = {
        "bandwidth": bandwidth(seconds, traffic),
        "milliseconds_of_exponentials": 1e3 * LEVELS * np.median(seconds["exponentials"]).item(),
    }
    for name in NAMES:
        floor = needed[name] / fastest
        found[name] = {
            "bytes": needed[name],
            "milliseconds": 1e3 * np.median(seconds[name]).item(),
            "milliseconds_of_floor": 1e3 * floor,
            "ratio": np.quantile(seconds[name] / floor, [0.25, 0.5, 0.75]).tolist(),
        }
    return found


def main(folder: Path, turns: int = TURNS) -> None:
    """Measures, prints a table, and writes results.json and filters.png."""
    measured = {
        f"{name}, {channels} channel{'s' if channels > 1 else ''}": (
            time_turns(space, channels, turns),
            4 * math.prod(space) * channels,
        )
        for name, space in SPACES.items()
        for channels in CHANNELS
    }
    fastest = max(bandwidth(*each) for each in measured.values())
    results = {size: compare(*each, fastest) for size, each in measured.items()}
    folder.mkdir(parents=True, exist_ok=True)
    content = {
        "command": "python -m benchmarks filters",
        "levels": LEVELS,
        "turns": turns,
        "target": TARGET,
        "device": str(jax.devices()[0].device_kind),
        "machine": machine(),
        "sizes": results,
    }
    (folder / "results.json").write_text(json.dumps(content, indent=1) + "\n")
    _draw(results, folder / "filters.png")
    Console().print(_table(results, turns))


def _table(results: dict[str, Any], turns: int) -> Table:
    shown = Table(
        title=f"Filters on grids, {LEVELS} levels of cross_bilateral: time over memory traffic",
        caption=f"Median \\[quartiles] of {turns} turns; target: at most {TARGET:.0f}.",
    )
    for column in ("size", "GB/s", "filter", "ratio", "ms", "ms of floor", "ms of exponentials"):
        shown.add_column(column, justify="left" if column in ("size", "filter") else "right")
    for size, found in results.items():
        for name in NAMES:
            low, middle, high = found[name]["ratio"]
            alone = f"{found['milliseconds_of_exponentials']:.2f}"
            shown.add_row(
                size,
                f"{1e-9 * found['bandwidth']:.1f}",
                name,
                f"{middle:.1f} \\[{low:.1f}, {high:.1f}]",
                f"{found[name]['milliseconds']:.2f}",
                f"{found[name]['milliseconds_of_floor']:.2f}",
                alone if name == "cross_bilateral" else "",
            )
    return shown


def _draw(results: dict[str, Any], path: Path) -> None:
    with figure(path, 1, 2, (8, 3.6)) as (drawn, axes):
        for axis, name, colour in zip(axes[0], NAMES, COLOURS, strict=False):
            times = [found[name]["milliseconds"] for found in results.values()]
            floors = [found[name]["milliseconds_of_floor"] for found in results.values()]
            places = np.arange(len(results))
            axis.hlines(places, floors, times, color="0.8", lw=2, zorder=1)
            axis.plot(floors, places, "|", ms=12, mew=2, color="0.4", label="memory traffic")
            axis.plot(
                TARGET * np.array(floors),
                places,
                "|",
                ms=12,
                color="0.7",
                label=f"{TARGET:.0f} times",
            )
            if name == "cross_bilateral":
                alone = [found["milliseconds_of_exponentials"] for found in results.values()]
                axis.plot(alone, places, "x", color=COLOURS[2], label="exponentials alone")
            axis.plot(times, places, "o", color=colour, label="filter")
            axis.set(xscale="log", xlabel="Milliseconds", title=name)
            axis.set(yticks=places, yticklabels=list(results) if axis is axes[0, 0] else [])
            axis.invert_yaxis()
        drawn.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
