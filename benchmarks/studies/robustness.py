"""How much starts, samples, render noise and compression of the reference matter.

After appendix I and Fig. 10 of Stochastic Gradient Estimation for Higher-order Differentiable
Rendering. A JPEG's level is its RMS error over the picture's RMS, in linear RGB: the paper does not
say what its 2 to 14 % are; on its scene, the mug, they then are qualities from 97 to 20.
"""

import dataclasses
import io
from argparse import Namespace
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image

import smoothdiff as sd
from benchmarks import _registry
from benchmarks._atlas import display
from benchmarks._grid import Grid, Row, spread
from benchmarks._loop import Run, able, flat, run
from benchmarks._names import name_of
from benchmarks._study import setting
from benchmarks._style import band, figure, legend, looks
from benchmarks._summary import COSTS, cost_to_level, quartiles
from benchmarks._task import Budget, Method, Problem, Solve, Task, Y
from benchmarks.methods._host_loop import run_by

HELP = "starts, samples, render noise, JPEG"
OPTIONS = ("full", "fresh")
SCENES = ("shadow", "mug")
STARTS = {"quick": (12, 5), "full": (60, 20)}  # of the study of starts, of a value of the others
LEVEL = 0.1  # what is left of the parameter error where costs are read
SOLVED = 0.1  # of sigma: nearer than this is found
BINS = 4  # of starts, by how far they are away
AXES = {"samples": "Evaluations of a step", "spp": "Samples of a pixel", "jpeg": "JPEG error, %"}
USUAL = ("fr22", "newton_cg", "gauss_newton")
SAMPLES = (4, 6, 8, 12, 24)  # evaluations of a step; the defaults are 4 and 6 for 1 and 2 unknowns
SPP = (1, 4, 9, 16)  # squares, which spread evenly; 0.25 to 4 times the task's
JPEG = (0, 2, 4, 6, 9, 14)  # percent
BUDGET = Budget(evaluations=240, seconds=60)  # ours are at their end long before


class Case(NamedTuple):
    """A study, one value of what it varies, what is run then, and from how many starts."""

    study: str
    value: int
    task: Task
    methods: list[Method]
    starts: int


def cases(build: Callable[..., Any], starts: int, seeds: int) -> Iterator[Case]:
    """What is run of a scene: anywhere from so many starts, all else from so many of its own."""
    task, methods = scored(build(False)), [_registry.method(name) for name in USUAL]
    yield Case("starts", 0, anywhere(task), methods, starts)
    for spp in SPP:
        yield Case("spp", spp, scored(build(False, spp=spp)), methods, seeds)
    for level in JPEG:
        yield Case("jpeg", level, compressed(task, level / 100), methods, seeds)
    for number in SAMPLES:
        yield Case("samples", number, task, sampling(number), seeds)


def scored(task: Task) -> Task:
    """A task of these runs. It is scored by its parameters only.

    Pictures without noise for a score would take most of a run.
    """
    away = lambda y: jnp.sum((y - task.score.reference) ** 2)
    score = dataclasses.replace(task.score, loss=away)
    problem = dataclasses.replace(task.problem, budget=BUDGET)
    return dataclasses.replace(task, problem=problem, score=score)


def anywhere(task: Task) -> Task:
    """Starts uniform within the bounds: also nearer to the reference and farther than usual."""
    low, high = task.problem.bounds
    uniform = lambda seed: jax.random.uniform(jax.random.key(seed), low.shape, low.dtype, low, high)
    return dataclasses.replace(task, start=uniform)


def sampling(number: int) -> list[Method]:
    """Ours with so many evaluations in a step, under the names of the usual ones."""

    def newton_cg(problem: Problem) -> Solve:
        solver = sd.NewtonCG(problem.sigma, restarts=2**31 - 1, num_samples=number)
        return run_by(sd.minimise, problem, problem.loss, solver)

    def gauss_newton(problem: Problem) -> Solve:
        solver = sd.GaussNewton(problem.sigma, num_samples=number)
        return run_by(sd.least_squares, problem, residuals(problem), solver)

    changed = {"newton_cg": newton_cg, "gauss_newton": gauss_newton}
    usual = {name: _registry.method(name) for name in changed}
    return [usual[name]._replace(prepare=prepare) for name, prepare in changed.items()]


def residuals(problem: Problem) -> Callable[[Y], jax.Array]:
    """Those of a problem that has some."""
    assert problem.residuals is not None
    return problem.residuals


def compressed(task: Task, level: float) -> Task:
    """The task with the JPEG of this level as its reference, instead of the photograph."""
    assert task.score.image is not None
    error = jpeg(np.asarray(task.score.image(task.score.reference)), level)
    exact = residuals(task.problem)
    changed = dataclasses.replace(task.problem, loss=None, residuals=lambda y: exact(y) - error)
    return dataclasses.replace(task, problem=changed)


def jpeg(linear: np.ndarray, level: float) -> np.ndarray:
    """What compression of the quality nearest to the level changes, (H, W, 3) in linear RGB."""
    if level == 0:
        return np.zeros_like(linear)
    size = lambda picture: np.sqrt(np.mean(picture**2))
    errors = [_decoded(linear, quality) - linear for quality in range(1, 101)]
    nearest = min(errors, key=lambda error: abs(size(error) / size(linear) - level))
    return nearest.astype(linear.dtype)


def _decoded(linear: np.ndarray, quality: int) -> np.ndarray:
    written = io.BytesIO()
    shown = np.rint(255 * display(linear)).astype(np.uint8)
    Image.fromarray(shown).save(written, "jpeg", quality=quality)
    with Image.open(written) as compressed:
        shown = np.asarray(compressed) / 255
    return np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)


def measure(options: Namespace, folder: Path) -> dict[str, Any]:
    """What the methods take in each case of each study of each scene."""
    scenes: dict[str, Any] = {name: {} for name in SCENES}
    how: dict[str, Any] = {"setting": setting(options), "fresh": options.fresh}
    for name, studies in scenes.items():
        for case in cases(_registry.task(name).build, *STARTS[how["setting"]]):
            into = folder / "runs" / name / f"{case.study}-{case.value}"
            runs = run(case.task, case.methods, range(case.starts), into, **how)
            for method, found in able(runs).items():
                lines = studies.setdefault(case.study, {}).setdefault(method.name, [])
                lines.append(line(case, found))
    return {"scenes": scenes}


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
                    cells = (study, value, name_of(name), *costs, solved)
                    rows.append(Row(scene, cells))
            rows[-1] = rows[-1]._replace(end=True)
    caption = (
        "Median [quartiles] to 90 % of the parameter error, and the final distance in units of "
        f"sigma; solved ends within {SOLVED}. - is not reached."
    )
    columns = ("scene", "study", "value", "method", *COSTS, "final distance", "solved")
    return [Grid("Robustness", caption, columns, tuple(rows))]


def draw(results: dict[str, Any], folder: Path) -> None:
    """Success and the final distance against the start's; costs and distance in each study."""
    scenes = results["scenes"]
    look = {name: style | {"marker": "o", "ms": 3} for name, style in looks(USUAL).items()}
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
        legend(drawn, handles, list(map(name_of, names)))


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
            band(axis, values, parts, look[name])
    above.set(yscale="log", ylabel="Evaluations to 90 %")
    below.set(ylabel="Final distance, in sigma")
