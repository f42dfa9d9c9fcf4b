"""What the savings of the scenes are worth: a render as it is, and without each of them.

Times the evaluations that ours takes to 99 %, as results have them, that is what a saving is worth
in seconds; as if the dearer picture took as many evaluations.
"""

import math
from argparse import Namespace
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks import _registry
from benchmarks._grid import Grid, short
from benchmarks._reached import took
from benchmarks._study import COMMITTED
from benchmarks._style import COLOURS, figure
from benchmarks._task import NotAble, Task
from benchmarks._timing import in_turns
from benchmarks.scenes.mitsuba_scene import SAVINGS
from benchmarks.studies._listed import listed
from benchmarks.studies.report._scene import load

HELP = "what the savings of the scenes are worth in seconds"
OPTIONS = ()
TURNS = 25
# of ours, by what they know of the loss
FIRST = ("first_order", "local_gradient", "local_first_order")
SECOND = ("newton_cg", "gauss_newton", "local_gauss_newton")


def measure(options: Namespace, folder: Path) -> dict[str, Any]:
    """Times of the scenes with savings that can be undone, and what runs have taken there."""
    found = {}
    for name in tqdm(_registry.scenes(), unit="scene"):
        try:
            task = _registry.task(name).build(False)
        except NotAble:
            continue
        if isinstance(task, Task) and task.dearer is not None:
            found[name] = {"notes": task.notes, "milliseconds": milliseconds(task)}
            found[name] |= to_99(name, (folder.parent, COMMITTED))
    return {"turns": TURNS, "scenes": found}


def milliseconds(task: Task) -> dict[str, float]:
    """Of a render, the fastest of several: what else the machine does only adds."""
    assert task.dearer is not None
    starts = [task.start(seed) for seed in range(TURNS + 1)]
    renders = {
        name: lambda turn, render=render: render(starts[turn])
        for name, render in task.dearer().items()
    }
    return {name: 1e3 * seconds.min() for name, seconds in in_turns(renders, TURNS).items()}


def to_99(name: str, folders: Sequence[Path]) -> dict[str, float | None]:
    """Evaluations of ours to 99 % of the image error, and seconds of the fastest by their order.

    The first of the folders that has results of the scene is read.
    """
    scene = next((scene for folder in folders for scene in load(name, folder)), None)
    if scene is None:
        return dict.fromkeys(("evaluations", "first order", "second order"))

    def fastest(methods: Sequence[str | None], cost: str) -> float | None:
        ran = (name for name in methods if name in scene.ran)
        medians = (took(scene.ran[name], cost).median for name in ran)
        return min((each for each in medians if math.isfinite(each)), default=None)

    return {
        "evaluations": fastest([scene.ours], "evaluations"),
        "first order": fastest(FIRST, "seconds"),
        "second order": fastest(SECOND, "seconds"),
    }


def tables(results: dict[str, Any]) -> Iterator[Grid]:
    """A line for each scene."""
    lines = []
    for name, found in results["scenes"].items():
        each, number = found["milliseconds"], found["evaluations"]
        # seconds of as many renders as ours takes
        worth = lambda ms, number=number: f"{short(ms / 1e3 * number)} s " if number else ""
        line = {"scene": name, "renders": worth(each[""]), "one": f"{each['']:.1f} ms"}
        for saving, title in SAVINGS.items():
            ratio = short(each[saving] / each[""])
            line[title] = f"{worth(each[saving] - each[''])}({ratio})"
        lines.append(
            line | {f"{order}, s": found[order] for order in ("first order", "second order")}
        )
    yield listed(
        "What the savings are worth",
        "Seconds that the renders of ours take to 99 % of the image error; how many more they "
        "would take without a saving, if there were as many of them; and in brackets, how many "
        "times as long. At the end, what a whole run to 99 % took when it was made: by the "
        "fastest of ours that use first derivatives, and of those that use second ones.",
        lines,
    )


def draw(results: dict[str, Any], folder: Path) -> None:
    """A group of bars for each scene."""
    renders = {name: found["milliseconds"] for name, found in results["scenes"].items()}
    places, height = np.arange(len(renders)), 0.8 / len(SAVINGS)
    with figure(folder / "savings.png", 1, 1, (7, 1 + 0.6 * len(renders))) as (drawn, axes):
        axis = axes[0, 0]
        for i, (saving, title) in enumerate(SAVINGS.items()):
            times = np.array([took[saving] / took[""] for took in renders.values()])
            middle = places + (i - (len(SAVINGS) - 1) / 2) * height
            axis.barh(middle, times - 1, height, left=1, color=COLOURS[i], label=title)
        axis.axvline(1, color="0.2", lw=1)
        axis.set(xscale="log", xlabel="Times as long as the render as it is")
        axis.set_xticks([1, 2, 5, 10, 20], ["1", "2", "5", "10", "20"])
        axis.xaxis.minorticks_off()
        axis.set_yticks(places, [f"{name}\n{took['']:.1f} ms" for name, took in renders.items()])
        axis.set(ylim=(len(renders) - 0.5, -0.5))
        axis.grid(False, axis="y")
        drawn.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=3)
