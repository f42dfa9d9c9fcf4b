"""How much starts, samples, render noise and compression of the reference matter; Fig. 10."""

from argparse import Namespace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import _registry
from benchmarks._grid import Grid, Row, spread
from benchmarks._loop import Run, able, flat, run
from benchmarks._style import figure, legend, looks
from benchmarks._summary import COSTS, cost_to_level, quartiles
from benchmarks.studies.robustness._cases import USUAL, Case, cases

HELP = "starts, samples, render noise, JPEG"
OPTIONS = ("full", "fresh")
SCENES = ("shadow", "mug")
STARTS = {"quick": (12, 5), "full": (60, 20)}  # of the study of starts, of a value of the others
LEVEL = 0.1  # what is left of the parameter error where costs are read
SOLVED = 0.1  # of sigma: nearer than this is found
BINS = 4  # of starts, by how far they are away
AXES = {"samples": "Evaluations of a step", "spp": "Samples of a pixel", "jpeg": "JPEG error, %"}


def measure(options: Namespace, folder: Path) -> dict[str, Any]:
    """What the methods take in each case of each study of each scene."""
    setting = "full" if options.full else "quick"
    titles = {name: _registry.method(name).title for name in USUAL}
    scenes: dict[str, Any] = {name: {} for name in SCENES}
    for name, studies in scenes.items():
        for case in cases(_registry.task(name).build, *STARTS[setting]):
            into = folder / "runs" / name / f"{case.study}-{case.value}"
            seeds, fresh = range(case.starts), options.fresh
            runs = run(case.task, case.methods, seeds, into, setting=setting, fresh=fresh)
            for method, found in able(runs).items():
                lines = studies.setdefault(case.study, {}).setdefault(method.name, [])
                lines.append(line(case, found))
    return {"titles": titles, "scenes": scenes}


def line(case: Case, runs: list[Run]) -> dict[str, Any]:
    """What the runs took, and how far from the reference, in sigmas, they began and ended."""
    task, sigma = case.task, case.task.problem.sigma
    took = {
        cost: quartiles([cost_to_level(run["parameter_error"], run[cost], LEVEL) for run in runs])
        for cost in COSTS
    }
    starts = (task.start(run["seed"]) for run in runs)
    begun = [float(np.linalg.norm(flat(y) - flat(task.score.reference))) / sigma for y in starts]
    ended = [run["distance"] / sigma for run in runs]
    about = {"value": case.value, "distance": quartiles(ended), "begun": begun, "ended": ended}
    return about | took


def tables(results: dict[str, Any]) -> list[Grid]:
    """All numbers."""
    rows = []
    for scene, studies in results["scenes"].items():
        for study, methods in studies.items():
            for name, found in methods.items():
                for each in found:
                    value = str(each["value"]) if study in AXES else ""
                    costs = (spread(each[what]) for what in (*COSTS, "distance"))
                    solved = f"{sum(end < SOLVED for end in each['ended'])}/{len(each['ended'])}"
                    rows.append(Row(scene, (study, value, name, *costs, solved)))
            rows[-1] = rows[-1]._replace(end=True)
    caption = (
        "Median [quartiles] to 90 % of the parameter error, and the final distance in units of "
        f"sigma; solved ends within {SOLVED}. - is not reached."
    )
    columns = ("scene", "study", "value", "method", *COSTS, "final distance", "solved")
    return [Grid("Robustness", caption, columns, tuple(rows))]


def draw(results: dict[str, Any], folder: Path) -> None:
    """Success and the final distance against the start's; costs and distance in each study."""
    scenes, titles = results["scenes"], results["titles"]
    look = {name: style | {"marker": "o", "ms": 3} for name, style in looks(titles).items()}
    size = (13, 5 * len(scenes))
    with figure(folder / "robustness.png", 2 * len(scenes), 4, size) as (drawn, axes):
        for i, (scene, studies) in enumerate(scenes.items()):
            above, below = axes[2 * i], axes[2 * i + 1]
            _starts(above[0], below[0], studies["starts"], look)
            above[0].set_title(scene)
            for column, (study, label) in enumerate(AXES.items(), start=1):
                _study(above[column], below[column], studies[study], look)
                below[column].set_xlabel(label)
            for axis in below:
                axis.set_yscale("log")
                axis.axhline(SOLVED, color="0.6", lw=0.6, ls=":")
        handles, names = axes[0, 0].get_legend_handles_labels()
        legend(drawn, handles, [titles[name] for name in names])


def _starts(above: Any, below: Any, methods: dict[str, Any], look: dict[str, dict]) -> None:
    """Of starts that are about as far away, how many are solved; and where each one ends."""
    for name, (found,) in methods.items():
        begun, ended = np.asarray(found["begun"]), np.asarray(found["ended"])
        bins = np.array_split(np.argsort(begun), BINS)
        share = [np.mean(ended[b] < SOLVED) for b in bins]
        above.plot([np.median(begun[b]) for b in bins], share, label=name, **look[name])
        below.plot(begun, ended, ls="none", color=look[name]["color"], marker="o", ms=3)
    above.set(ylim=(-0.05, 1.05), ylabel=f"Share that ends within {SOLVED} sigma")
    below.set(xlabel="Distance of the start, in sigma", ylabel="Final distance")


def _study(above: Any, below: Any, methods: dict[str, Any], look: dict[str, dict]) -> None:
    """Medians and quartiles over the starts; a median that is not there is not drawn."""
    for name, found in methods.items():
        for axis, what in ((above, "evaluations"), (below, "distance")):
            values = [each["value"] for each in found]
            parts = [[each[what][part] for each in found] for part in ("lower", "median", "upper")]
            low, middle, high = np.array(parts, float)
            axis.plot(values, middle, **look[name])
            axis.fill_between(values, low, high, color=look[name]["color"], alpha=0.15, lw=0)
    above.set(yscale="log", ylabel="Evaluations to 90 %")
    below.set(ylabel="Final distance, in sigma")
