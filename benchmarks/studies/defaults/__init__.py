"""The shortest call against the best of hand-chosen settings: how many evaluations each takes.

Six problems of these benchmarks and four simulators of other libraries, from ten starts each. The
shortest call is told the function, the start, what the parameters may be and a key. The others are
told a sigma as well, from an eighth to four times a fifth of the range. A run is there once what
it found is within one percent of the way from the start to the lowest that any from there found.
"""

from argparse import Namespace
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import smoothdiff as sd
from benchmarks import _registry
from benchmarks._cache import cached, library
from benchmarks._grid import Grid
from benchmarks._summary import quartiles
from benchmarks._task import NotAble
from benchmarks.studies._listed import dots, listed
from benchmarks.studies.defaults.simulators import SIMULATORS

HELP = "the shortest call against the best of hand-chosen settings"
OPTIONS = ("names", "seeds", "fresh")
TASKS = ("shadow", "mug", "bunny", "box2", "quad", "brdf")
STARTS = 10
FACTORS = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0)  # of a fifth of a range
SHARE = 0.2  # of a range, the sigma of factor 1
BUDGET = 150
LEVEL = 0.01
TARGET = 1.3


class Case(NamedTuple):
    """A problem as a user has it; `error` is what counts of what was found."""

    title: str
    fun: Callable[[Any, Any], Any]
    minimise: Callable[..., sd.Result]
    start: Callable[[int], Any]
    where: dict[str, Any]
    sigma: Callable[[float], Any]
    error: Callable[[Any], float] | None


def of_task(name: str) -> Case:
    """With bounds, on the residuals if there are some, scored by the picture without noise."""
    (task,) = _registry.family(name, False)
    problem, score = task.problem, task.score
    residuals, image = problem.residuals, score.image
    error = jax.jit(score.loss or problem.loss)
    if image is not None:
        reference = image(score.reference)
        error = jax.jit(lambda y: jnp.mean((image(y) - reference) ** 2))
    low, high = problem.bounds
    return Case(
        name,
        (lambda y, args: problem.loss(y)) if residuals is None else lambda y, args: residuals(y),
        sd.minimise if residuals is None else sd.least_squares,
        task.start,
        {"bounds": problem.bounds},
        lambda factor: jax.tree.map(lambda a, b: factor * SHARE * (b - a), low, high),
        lambda y: float(error(y)),
    )


def of_simulator(name: str) -> Case:
    """With ranges; what it returns has no noise, and is its own error."""
    simulator = SIMULATORS[name]
    return Case(
        simulator.title,
        simulator.fun(),
        sd.minimise if simulator.truth is None else sd.least_squares,
        simulator.start,
        {"space": simulator.space},
        lambda factor: factor * SHARE,
        None,
    )


def cases(names: list[str]) -> Iterator[tuple[str, Case]]:
    """Those with these names, or all."""
    known = dict.fromkeys(TASKS, of_task) | dict.fromkeys(SIMULATORS, of_simulator)
    for name in (name for name in names if name not in known):
        raise SystemExit(f"There is no {name!r}; choose from {', '.join(known)}.")
    for name in names or known:
        try:
            yield name, known[name](name)
        except NotAble as reason:
            print(f"{name}: {reason}")


def trace(case: Case, seed: int, factor: float | None) -> dict[str, Any]:
    """Errors from the start on; without a factor those of the shortest call."""
    y0 = case.start(seed)
    chosen = {} if factor is None else {"sigma": case.sigma(factor)}
    evaluations, errors = [0], [np.inf if case.error is None else case.error(y0)]

    def look(record: sd.Record) -> bool:
        evaluations.append(record.evaluations)
        errors.append(record.fun if case.error is None else case.error(record.y))
        first = errors[1] if case.error is None else errors[0]
        return errors[-1] <= LEVEL / 2 * first

    key = jax.random.key(seed)
    limit = {"max_evaluations": BUDGET, "callback": look}
    result = case.minimise(case.fun, y0, key=key, **case.where, **chosen, **limit)
    if case.error is None:
        errors[0] = errors[1]  # the first evaluation is that of the start
    about = {"ended": result.reason, "solver": type(result.solver).__name__}
    return about | {"evaluations": np.array(evaluations), "errors": np.array(errors)}


def measure(options: Namespace, folder: Path) -> dict[str, Any]:
    """Of each case the evaluations from each start, by the shortest call and by each setting."""
    lines = []
    for name, case in cases(options.names):
        took, runs = {factor: [] for factor in (None, *FACTORS)}, {}
        for seed in tqdm(range(options.seeds or STARTS), desc=name, unit="start"):
            for factor in took:
                path = folder / "runs" / name / f"{seed}-{factor}.npz"
                make = partial(trace, case, seed, factor)
                runs[factor] = cached(path, library(), make, options.fresh)
            lowest = min(np.min(run["errors"]) for run in runs.values())
            for factor, run in runs.items():
                took[factor].append(there(run, lowest))
        lines.append(line(name, case.title, runs[None]["solver"], took))
    return {"cases": lines}


def there(run: dict[str, Any], lowest: float) -> float:
    """Evaluations until the error is as low as is asked for."""
    errors = run["errors"]
    reached = errors <= lowest + LEVEL * (errors[0] - lowest)
    return float(run["evaluations"][np.argmax(reached)]) if np.any(reached) else np.inf


def line(name: str, title: str, solver: str, took: dict[Any, list[float]]) -> dict[str, Any]:
    """Medians of the shortest call and of the best setting, and their ratio."""
    best = min(FACTORS, key=lambda factor: (np.median(took[factor]), float(np.mean(took[factor]))))
    found = {"shortest": quartiles(took[None]), "best": quartiles(took[best]), "factor": best}
    ours, theirs = (float(np.median(took[each])) for each in (None, best))
    solved = {
        "shortest": sum(map(np.isfinite, took[None])),
        "best": sum(map(np.isfinite, took[best])),
    }
    return {
        "name": name,
        "title": title,
        "solver": solver,
        "ratio": ours / theirs if np.isfinite(ours) else None,
        "solved": {key: int(number) for key, number in solved.items()},
        "took": {str(factor): values for factor, values in took.items()},
    } | found


def tables(results: dict[str, Any]) -> list[Grid]:
    """A line for each case."""
    of = lambda found: [found[name] for name in ("lower", "median", "upper")]
    lines = [
        {
            "case": case["title"],
            "solver": case["solver"],
            "shortest call": of(case["shortest"]),
            "solved": f"{case['solved']['shortest']}/{len(case['took']['None'])}",
            "best sigma": of(case["best"]),
            "solved there": f"{case['solved']['best']}/{len(case['took']['None'])}",
            "times a fifth of the range": case["factor"],
            "ratio": case["ratio"],
        }
        for case in results["cases"]
    ]
    caption = (
        f"Median evaluations [quartiles] from so many starts, to within {100 * LEVEL:g} % of the "
        f"lowest found from there. The best sigma is chosen on these starts; {TARGET} is asked for."
    )
    return [listed("The shortest call", caption, lines)]


def draw(results: dict[str, Any], folder: Path) -> None:
    """The ratio of the medians of each case."""
    ratios = {case["title"]: case["ratio"] for case in results["cases"]}
    rows = {name: [np.inf if ratio is None else ratio] for name, ratio in ratios.items()}
    label = "evaluations of the shortest call over those of the best hand-chosen sigma"
    dots(folder / "defaults.png", rows, TARGET, label, (0.5, 3.0))
