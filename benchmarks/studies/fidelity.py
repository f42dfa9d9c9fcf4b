"""Cheap renders first: scenes as a user would set them, against settings that were chosen by hand.

A scene has many pixels, many samples of each, and light that bounces up to eight times. It is given
to `least_squares` as it is, and to `coarse_to_fine` by way of cheaper levels that nobody chose. The
third run is of the scene as all other benchmarks have it: the cheapest one that was found by hand.
"""

import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from statistics import geometric_mean
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

import smoothdiff as sd
from benchmarks import _registry
from benchmarks._cache import cached, fingerprint, library
from benchmarks._grid import Grid, short
from benchmarks._loop import behaviour
from benchmarks._study import setting
from benchmarks._style import COLOURS, figure
from benchmarks._summary import quartiles
from benchmarks._task import NotAble, Task
from benchmarks.studies._listed import listed

HELP = "cheap renders first, against one fidelity"
OPTIONS = ("names", "full", "seeds", "fresh")
SIZE = {False: (128, 16), True: (256, 64)}  # pixels along a side, samples of each
STARTS = 3
MOST = 60  # renders of a scene as it is, or what they cost
MOST_CHEAP = 300  # renders of the scene that was chosen by hand
DONE = 0.01  # of the image error: 99 % less
TURNS = 5  # renders that are timed
WAYS = {
    "full": "the full setting",
    "levels": "coarse to fine",
    "chosen": "chosen by hand",
}


def measure(options: Namespace, folder: Path) -> dict[str, Any]:
    """Of each scene what each way took to 99 % and what it left, from each start."""
    pixels, samples = SIZE[options.full]
    scenes = {}
    for name in tqdm(options.names or _registry.scenes(), unit="scene"):
        try:
            (task,) = _registry.family(name, False)
        except NotAble:
            continue
        if task.fidelities is None:
            continue
        make, seeds = partial(Fidelities, task, pixels, samples), range(options.seeds or STARTS)
        scenes[name] = of_scene(task, make, seeds, options, folder / "runs" / name)
    return {"pixels": pixels, "samples": samples, "scenes": scenes}


def of_scene(
    task: Task, make: Callable, seeds: range, options: Namespace, folder: Path
) -> dict[str, Any]:
    """The runs of each way, kept one by one."""
    found: dict[str, Any] = {"title": task.title, "starts": len(seeds)}
    made: list[Fidelities] = []
    stale = fingerprint(library(), behaviour(task), SIZE[options.full], MOST, MOST_CHEAP, TURNS)
    for way in WAYS:
        runs = []
        for seed in tqdm(seeds, desc=f"{task.name}, {way}", leave=False):

            def run(way: str = way, seed: int = seed) -> dict[str, Any]:
                made[:] = made or [make()]
                return made[0].run(way, seed)

            path = folder / f"{way}-{seed}-{setting(options)}.npz"
            runs.append(cached(path, stale, run, options.fresh))
        found[way] = {
            name: quartiles([run[name] for run in runs]) for name in ("seconds", "call", "left")
        }
        found[way]["solved"] = int(sum(np.isfinite(run["seconds"]) for run in runs))
        found[way]["milliseconds"] = runs[-1]["milliseconds"].tolist()
    return found


class Fidelities:
    """A scene at all of its fidelities, with what a render of each takes."""

    def __init__(self, task: Task, pixels: int, samples: int):
        assert task.fidelities is not None
        assert task.problem.residuals is not None
        residuals = task.problem.residuals
        self.task, self.levels = task, task.fidelities(pixels, samples)
        self.chosen = sd.Level(lambda y, args: residuals(y), 1.0)
        self.loss = jax.jit(task.exact_loss)
        self.times = {id(level): seconds(task, level) for level in (*self.levels, self.chosen)}

    def run(self, way: str, seed: int) -> dict[str, Any]:
        """Seconds of rendering to 99 %, those of the call until then, what is left at the end."""
        y0 = self.task.start(seed)
        at_start = float(self.loss(y0))
        watch = Watch(lambda y: float(self.loss(y)) / at_start)
        options = {"key": jax.random.key(seed), "bounds": self.task.problem.bounds}
        levels = {"full": self.levels[-1:], "levels": self.levels, "chosen": [self.chosen]}[way]
        most = MOST_CHEAP if way == "chosen" else MOST

        def minimiser(fun: Any, *args: Any, **rest: Any) -> sd.Result:
            (level,) = (level for level in levels if level.fun is fun)
            watch.each = self.times[id(level)]
            found = sd.least_squares(fun, *args, **rest)
            watch.spent += found.evaluations * watch.each
            return found

        found = sd.coarse_to_fine(minimiser, levels, y0, max_cost=most, callback=watch, **options)
        return {
            "seconds": watch.reached,
            "call": watch.call,
            "left": watch.error(found.y),
            "milliseconds": np.array([1e3 * self.times[id(level)] for level in levels]),
        }


class Watch:
    """A callback that notes after how many seconds 99 % of the error are gone.

    `reached` counts rendering alone, `call` all of the call, with compiling.
    """

    def __init__(self, error: Callable[[Any], float]):
        self.error, self.reached, self.call = error, np.inf, np.inf
        self.spent = self.each = 0.0
        self.began = time.process_time()

    def __call__(self, record: sd.Record) -> None:
        now = time.process_time()
        if np.isinf(self.reached) and self.error(record.best) <= DONE:
            self.reached = self.spent + record.evaluations * self.each
            self.call = now - self.began
        # scoring is not the call's
        self.began += time.process_time() - now


def seconds(task: Task, level: sd.Level) -> float:
    """CPU seconds of a render, the fastest of several: what else the machine does only adds."""
    render = jax.jit(lambda y: level.fun(y, None))
    taken = []
    for seed in range(TURNS + 1):  # the first one compiles
        began = time.process_time()
        jax.block_until_ready(render(task.start(seed)))
        taken.append(time.process_time() - began)
    return min(taken[1:])


def means(results: dict[str, Any]) -> dict[str, float | None]:
    """Geometric means of ratios of medians, over the scenes that both solve from most starts."""

    def mean(way: str, other: str) -> float | None:
        pairs = [(scene[way], scene[other]) for scene in results["scenes"].values()]
        medians = [(a["seconds"]["median"], b["seconds"]["median"]) for a, b in pairs]
        known = [a / b for a, b in medians if a is not None and b is not None]
        return geometric_mean(known) if known else None

    return {
        "full over levels": mean("full", "levels"),
        "levels over chosen": mean("levels", "chosen"),
    }


def tables(results: dict[str, Any]) -> Iterator[Grid]:
    """A line for each scene."""
    lines = []
    for name, scene in results["scenes"].items():
        line: dict[str, Any] = {"scene": name}
        for way, title in WAYS.items():
            found, solved = scene[way], scene[way]["solved"]
            some = f" ({solved})" if solved < scene["starts"] else ""
            line[f"{title}, s"] = short(found["seconds"]["median"]) + some
            line[f"{way}, call, s"] = short(found["call"]["median"])
            line[f"{way}, left, %"] = short(100 * found["left"]["median"])
        lines.append(line)
    said = [f"{name}: {mean:.2g}" for name, mean in means(results).items() if mean is not None]
    yield listed(
        "Cheap renders first",
        f"{results['pixels']} x {results['pixels']} pixels, {results['samples']} samples of each, "
        "paths of length 8. CPU seconds of rendering to 99 % of the image error, CPU seconds of "
        "the call until then, of which a first start compiles, and what is left at the end. "
        f"Medians; geometric means of seconds of rendering: {'; '.join(said)}.",
        lines,
    )


def draw(results: dict[str, Any], folder: Path) -> None:
    """The seconds of each way from quartile to quartile; none where half do not get there."""
    scenes = results["scenes"]
    with figure(folder / "fidelity.png", 1, 1, (7, 1 + 0.5 * len(scenes))) as (drawn, axes):
        axis, places = axes[0, 0], np.arange(len(scenes))
        for i, (way, title) in enumerate(WAYS.items()):
            each = [scene[way]["seconds"] for scene in scenes.values()]
            names = "lower", "median", "upper"
            low, middle, high = (
                [np.nan if q[name] is None else q[name] for q in each] for name in names
            )
            axis.hlines(places + 0.2 * (i - 1), low, high, color=COLOURS[i], lw=5, alpha=0.4)
            axis.plot(middle, places + 0.2 * (i - 1), "o", color=COLOURS[i], label=title)
        axis.set(xscale="log", xlabel="CPU seconds of rendering to 99 % of the image error")
        axis.set(yticks=places, yticklabels=scenes, ylim=(len(scenes) - 0.5, -0.5))
        drawn.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=3)
