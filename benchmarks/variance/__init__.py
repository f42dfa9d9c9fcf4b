"""How far estimates of derivatives are from the truth, for their evaluations and for their time.

Every sampler and baseline, the papers' estimators and `optax.perturbations` estimate gradients,
Hessians and Hessian-vector products at random positions, where the truth is known in closed form.
The comparison is that of appendix J of Stochastic Gradient Estimation for Higher-order
Differentiable Rendering, with more estimators.
"""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from tqdm import tqdm

from benchmarks._summary import machine
from benchmarks.variance import compare, descent, fits, pictures, replicates, tables
from benchmarks.variance.estimators import FAIRER, OURS, PEER, PUBLISHED, estimators_for
from benchmarks.variance.measure import case, relative_rmse, rows
from benchmarks.variance.problems import PROBLEMS


class Setting(NamedTuple):
    """How much is run. `estimators` None means all; `repeats` is the number of positions."""

    name: str
    problems: tuple[str, ...]
    estimators: tuple[str, ...] | None
    samples: tuple[int, ...]
    repeats: dict[str, int]
    grid: descent.Grid
    costs: bool  # whether to ask what standard errors and fits cost


QUICK = Setting(
    name="quick",
    problems=("box2", "box10"),
    estimators=("gaussian-mean", "sobol-mean", OURS, PUBLISHED, FAIRER, PEER),
    samples=(16, 64, 256, 1024),
    repeats={"box2": 24, "box10": 24},
    grid=descent.SMALL_GRID,
    costs=False,
)
FULL = Setting(
    name="full",
    problems=tuple(PROBLEMS),
    estimators=None,
    samples=(8, 16, 64, 256, 1024, 4096),
    repeats={"quad": 24, "box2": 60, "box10": 60, "sphere": 24, "texture": 24},
    grid=descent.Grid(),
    costs=True,
)


def main(folder: Path, setting: Setting, *, command: str, fresh: bool = False) -> None:
    """Measures what has not been measured, prints tables, writes results.json and pictures."""
    measured = _measure(folder / "runs", setting, fresh)
    results: dict[str, Any] = {
        "command": command,
        "setting": setting.name,
        "machine": machine(),
        "problems": {
            problem: {
                "title": PROBLEMS[problem]().title,
                "repeats": setting.repeats[problem],
                "estimators": {
                    name: {"title": estimators_for(problem)[name].title} | _summary(by_num)
                    for name, by_num in found.items()
                },
            }
            for problem, found in measured.items()
        },
        "targets": compare.against_targets(measured),
        "ingredients": compare.ingredients(measured),
        "descent": descent.run(setting.grid),
    }
    if setting.costs:
        box10 = case("box10", setting.repeats["box10"])
        results["replicates"] = replicates.run(box10)
        results["fits"] = fits.run(box10)
        for line in results["fits"]:
            line["pays_from_us"] = compare.pays_from_us(measured["box10"], line)
    folder.mkdir(parents=True, exist_ok=True)
    # numbers become texts as keys: what is shown is what is written
    text = json.dumps(_rounded(results))
    (folder / "results.json").write_text(text + "\n")
    results = json.loads(text)
    pictures.draw(results, folder)
    console = Console()
    console.print(tables.render(results))
    console.print(f"Written to {folder}")


def _measure(folder: Path, setting: Setting, fresh: bool) -> compare.Measured:
    """Rows by problem, estimator, number of samples and quantity."""
    todo = [
        (problem, name, estimator, num)
        for problem in setting.problems
        for name, estimator in estimators_for(problem).items()
        if setting.estimators is None or name in setting.estimators
        for num in setting.samples
    ]
    measured: compare.Measured = {}
    with tqdm(todo, unit="row") as bar:
        for problem, name, estimator, num in bar:
            bar.set_description(f"{problem}: {name}, {num}")
            found = rows(
                case(problem, setting.repeats[problem]), name, estimator, num, folder, fresh
            )
            if found:
                measured.setdefault(problem, {}).setdefault(name, {})[num] = found
    return measured


def _summary(by_num: dict[int, dict[str, Any]]) -> dict[str, Any]:
    """For each quantity: evaluations, relative RMSE with its interval, median milliseconds."""
    out: dict[str, Any] = {}
    for num, found in by_num.items():
        for quantity, row in found.items():
            column = out.setdefault(
                quantity, {"samples": [], "evaluations": [], "rmse": [], "ms": []}
            )
            column["samples"].append(num)
            column["evaluations"].append(row.evaluations)
            column["rmse"].append(relative_rmse(row).tolist())
            column["ms"].append(1e3 * float(np.median(row.seconds)))
    return out


def _rounded(tree: Any) -> Any:
    """Numbers with the digits that they deserve."""
    if isinstance(tree, float):
        return float(f"{tree:.4g}")
    if isinstance(tree, dict):
        return {key: _rounded(value) for key, value in tree.items()}
    return [_rounded(value) for value in tree] if isinstance(tree, list) else tree
