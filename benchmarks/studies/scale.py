"""Many workers: rounds that wait for the slowest against a search that waits for none.

Durations are log-normal (sigma 1, mean 1), as those of simulators whose cost depends on their
parameters. The workers of a round begin together and the next round when all are back; otherwise a
worker gets a new point of `sd.Search` as soon as it is free. Time is simulated, so that a thousand
workers need one core; what `ask` and `tell` cost on the host is measured, and is not in it.

Then what is measured on this machine: one estimate on several devices, and calls by each executor.
"""

import heapq
import os
import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

import smoothdiff as sd
from benchmarks._grid import Grid
from benchmarks._style import COLOURS, figure
from benchmarks.studies import _devices, _workers
from benchmarks.studies._listed import listed

HELP = "4 to 1,024 simulated workers, waiting or not; devices and processes of this machine"
OPTIONS = ("full", "seeds")
STARTS = {False: 1, True: 10}
WORKERS = {False: (4, 32, 256), True: (4, 16, 64, 256, 1024)}
# a run ends at this share of the value at the start, or after so many evaluations for each worker
LEFT, ROUNDS, LEAST = 1e-3, 20, 1000
SPREAD = 1.0


def rosenbrock(y: np.ndarray) -> float:
    """A curved valley."""
    return float(100 * (y[1] - y[0] ** 2) ** 2 + (1 - y[0]) ** 2)


def ripples(y: np.ndarray) -> float:
    """A bowl with local minima."""
    return float(np.sum((y - 0.7) ** 2) + 0.05 * np.sum(1 - np.cos(8 * (y - 0.7))))


def stairs(y: np.ndarray) -> float:
    """A bowl of plateaus, whose lowest is zero."""
    return float(np.sum(np.floor(20 * np.abs(y - 0.7))) / 20)


FUNCTIONS: dict[str, tuple[Callable[[np.ndarray], float], int]] = {
    "Rosenbrock": (rosenbrock, 2),
    "ripples": (ripples, 4),
    "stairs": (stairs, 4),
}


def search(
    fun: Callable[[np.ndarray], float], n: int, workers: int, seed: int, waits: bool
) -> dict[str, float]:
    """A run: evaluations and simulated seconds to the answer, and seconds of the host for each."""
    random = np.random.default_rng(seed)
    y0 = random.uniform(-1, 0, n).astype(np.float32)
    asked = sd.Search(y0, key=jax.random.key(seed), sigma=0.5)
    goal, most = LEFT * fun(y0), max(ROUNDS * workers, LEAST)
    running: list[tuple[float, int, np.ndarray]] = []
    clock = host = busy = 0.0
    evaluations, ticket, best = 0, count(), np.inf
    while best > goal and evaluations < most:
        began = time.process_time()
        for point in asked.ask(workers - len(running)):
            duration = random.lognormal(-(SPREAD**2) / 2, SPREAD)
            busy += duration
            heapq.heappush(running, (clock + duration, next(ticket), point))
        back = [heapq.heappop(running) for _ in range(len(running) if waits else 1)]
        clock = back[-1][0]
        points = [point for _, _, point in back]
        values = [fun(point) for point in points]
        asked.tell(points, values)
        host += time.process_time() - began
        evaluations, best = evaluations + len(back), min(best, *values)
    busy -= sum(end - clock for end, _, _ in running)
    return {
        "evaluations": evaluations if best <= goal else float("inf"),
        "seconds": clock if best <= goal else float("inf"),
        "a second": evaluations / clock,
        "efficiency": busy / clock / workers,
        "host": host / evaluations,
    }


def measure(options: Namespace, folder: Path) -> dict[str, Any]:
    """Medians over starts for each function and number of workers, in rounds and without."""
    starts = options.seeds or STARTS[options.full]
    planned = [(name, n) for name in FUNCTIONS for n in WORKERS[options.full]]
    lines = []
    for name, workers in tqdm(planned, unit="line"):
        line: dict[str, Any] = {"function": name, "workers": workers}
        for way in ("rounds", "no waiting"):
            runs = [search(*FUNCTIONS[name], workers, i, way == "rounds") for i in range(starts)]
            line[way] = {of: float(np.median([run[of] for run in runs])) for of in runs[0]}
        lines.append(line)
    devices = list(
        tqdm(_devices.measured(), total=len(_devices.DEVICES) * len(_devices.WAYS), unit="line")
    )
    return {
        "starts": starts,
        "lines": lines,
        "cores": os.cpu_count(),
        "devices": devices,
        "executors": _workers.measured(),
    }


def tables(results: dict[str, Any]) -> Iterator[Grid]:
    """A line for each function and number of workers."""
    shown = lambda value, scale: "-" if value is None else f"{scale * value:.3g}"
    yield listed(
        "Workers",
        f"Simulated durations are log-normal with mean 1 s; medians of {results['starts']} starts. "
        f"In rounds / without waiting: evaluations a second, the share of time that workers work, "
        f"evaluations and seconds to {LEFT:g} of the value at the start, and what ask and tell "
        "cost the host, whose inverse is the number of workers with which efficiency ends.",
        [
            {
                "function": line["function"],
                "workers": line["workers"],
                **{
                    title: " / ".join(
                        shown(line[way][of], scale) for way in ("rounds", "no waiting")
                    )
                    for title, of, scale in (
                        ("a second", "a second", 1),
                        ("efficiency, %", "efficiency", 100),
                        ("evaluations", "evaluations", 1),
                        ("seconds", "seconds", 1),
                        ("host, ms", "host", 1000),
                    )
                },
            }
            for line in results["lines"]
        ],
    )
    share = f"They share {results['cores']} cores."
    yield listed(
        "Devices",
        f"One gradient; quartiles of {_devices.TURNS} calls. {share} Where CPU time stays at "
        "100 %, sharing out costs nothing.",
        results["devices"],
    )
    yield listed(
        "Calls of a host function",
        f"In batches of {_workers.CALLS}; quartiles of {_workers.TURNS} turns. {share}",
        results["executors"],
    )


def draw(results: dict[str, Any], folder: Path) -> None:
    """What is found of workers, and what of devices."""
    draw_workers(results, folder / "scale.png")
    draw_devices(results["devices"], folder / "devices.png")


def draw_workers(results: dict[str, Any], path: Path) -> None:
    """Evaluations a second, and evaluations and seconds to the answer, against workers."""
    titles = ("a second", "Evaluations a second"), ("evaluations", "Evaluations to the answer")
    titles += (("seconds", "Seconds to the answer"),)
    names = list(dict.fromkeys(line["function"] for line in results["lines"]))
    with figure(path, 1, 3, (10, 3.6)) as (drawn, axes):
        for axis, (of, title) in zip(axes[0], titles, strict=True):
            workers = sorted({line["workers"] for line in results["lines"]})
            for name, colour in zip(names, COLOURS, strict=False):
                lines = [line for line in results["lines"] if line["function"] == name]
                for way, dash in (("rounds", ":"), ("no waiting", "-")):
                    values = [line[way][of] or np.nan for line in lines]
                    axis.plot(
                        workers, values, dash, color=colour, marker=".", label=f"{name}, {way}"
                    )
            axis.set(xscale="log", yscale="log", xlabel="Workers", title=title)
            axis.set_xticks(workers, [str(count) for count in workers], minor=False)
            axis.tick_params(which="minor", bottom=False, labelbottom=False)
        drawn.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)


def draw_devices(lines: list[dict[str, Any]], path: Path) -> None:
    """How many times as fast a gradient is, and what CPU time it takes, against devices."""
    shown = ("times as fast", "Times as fast"), ("CPU time to one device's, %", "CPU time, %")
    with figure(path, 1, 2, (7, 3.6)) as (drawn, axes):
        for axis, (of, title) in zip(axes[0], shown, strict=True):
            for way, colour in zip(_devices.WAYS, COLOURS, strict=False):
                those = [line for line in lines if line["scaling"] == way]
                devices = [line["devices"] for line in those]
                axis.plot(
                    devices, [line[of] for line in those], color=colour, marker=".", label=way
                )
            axis.set(xscale="log", xlabel="Devices", title=title)
            axis.set_xticks(_devices.DEVICES, map(str, _devices.DEVICES), minor=False)
            axis.set_ylim(bottom=0)
            axis.tick_params(which="minor", bottom=False, labelbottom=False)
        drawn.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
