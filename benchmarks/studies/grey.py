"""What each part of `train_grey_box` gives, on pictures of a mug that nothing was chosen on.

The parts are added one after the other. The gradient is that of the loss of each case, by
`smooth_grad`, pulled back through the network. With Gauss-Newton case by case the network learns
what each case found by its own renders; with shared lessons all cases and the network learn from
all renders; and with new poses half of the renders are of poses that are like those found, and
parameters count as the root of how much pictures change with them. Poses of pictures, weights and
random numbers have other seeds than the tasks `cnn` and `cnn5`, and networks are judged on four
times as many pictures.
"""

import dataclasses
from argparse import Namespace
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import _loop, _registry
from benchmarks._grid import Grid
from benchmarks._style import COLOURS, figure
from benchmarks._task import Budget, Method, NotAble, Task
from benchmarks.methods import grey_gauss_newton
from benchmarks.studies._listed import listed

HELP = "grey boxes: what each part of the training of a network gives"
OPTIONS = ("full", "seeds", "fresh")
NETWORKS = ("cnn", "cnn5")
DATA = 1000  # the first seed of data that no task has
JUDGED = 128  # pictures
RENDERS, SEEDS = {False: 4000, True: 16_000}, {False: 1, True: 3}
PARTS = {
    "gradient": "gradient of each case",
    "cases": "Gauss-Newton case by case",
    "shared": "... and shared lessons",
    "whole": "... and new poses, and weights",
}
SETTINGS = {"cases": {"kept": 0}, "shared": {"new_parameters": False}, "whole": {}}


def measure(options: Namespace, folder: Path) -> dict[str, Any]:
    """What each part leaves of the image error, after each quarter of the renders."""
    seeds = range(options.seeds or SEEDS[options.full])
    renders, found = RENDERS[options.full], {}
    for name in NETWORKS:
        curves: dict[str, list] = {part: [] for part in PARTS}
        for seed in seeds:
            runs = _loop.run(
                mugs(name, DATA + seed, renders),
                [method(part) for part in PARTS],
                [DATA + seed],
                folder / f"{name}-{seed}-{renders}",
                fresh=options.fresh,
            )
            for ran, made in runs.items():
                assert not isinstance(made, NotAble)
                curves[ran.name].append(quarters(made[0], renders))
        found[name] = curves
    return {"renders": renders, "seeds": len(seeds), "left": found}


def mugs(name: str, data: int, renders: int) -> Task:
    """The task with other pictures, and as many renders as these, whatever time they take."""
    task = _registry.task(name).build(False, data=data, others=JUDGED)
    assert isinstance(task, Task)
    problem = dataclasses.replace(task.problem, budget=Budget(renders, 3600))
    return dataclasses.replace(task, problem=problem)


def method(part: str) -> Method:
    """The training with this part and those before it."""
    if part == "gradient":
        return _registry.method("grey_ours")._replace(name=part)
    whole = _registry.method("grey_gauss_newton")
    prepare = partial(grey_gauss_newton.prepare, **SETTINGS[part])
    return whole._replace(name=part, title=PARTS[part], prepare=prepare)


def quarters(run: dict[str, Any], renders: int) -> list[float]:
    """What is left after each quarter of the renders, in percent; at last, of the last network."""
    evaluations, errors = run["evaluations"], run["image_error"]
    at = [np.searchsorted(evaluations, renders * k // 4, side="right") - 1 for k in (1, 2, 3)]
    return [100 * float(errors[i]) for i in (*at, -1)]


def tables(results: dict[str, Any]) -> Iterator[Grid]:
    """A line for each part."""
    lines, renders = [], results["renders"]
    for network, curves in results["left"].items():
        for part, each in curves.items():
            line: dict[str, Any] = {"network": f"{network}, {PARTS[part]}"}
            for k, left in enumerate(np.array(each).T, 1):
                line[f"after {renders * k // 4}"] = np.quantile(left, (0, 0.5, 1)).tolist()
            lines.append(line)
    yield listed(
        "What each part gives",
        f"Percent of the image error that are left on {JUDGED} other pictures, after so many "
        f"renders: the median of {results['seeds']} sets of pictures, and the least and the most.",
        lines,
    )


def draw(results: dict[str, Any], folder: Path) -> None:
    """What is left against renders, a panel for each network."""
    at = results["renders"] * np.arange(1, 5) / 4
    with figure(folder / "grey.png", 1, len(NETWORKS), (8, 3.5)) as (drawn, axes):
        for axis, (network, curves) in zip(axes[0], results["left"].items(), strict=True):
            for i, (part, each) in enumerate(curves.items()):
                for j, left in enumerate(each):
                    label = PARTS[part] if j == 0 else None
                    axis.plot(at, left, ".-", color=COLOURS[i], label=label)
            axis.set(yscale="log", xlabel="Renders", title=network)
        axes[0, 0].set_ylabel("Image error left, percent")
        drawn.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
