"""Table 2 at equal schedules: how far others are behind ours, each with the best of one grid.

The paper compares after equal iterations where ours has taken 95 % of the error away; here it is
after equal evaluations, as finite differences have a step for hundreds of ours, and at the end too.
Where ours does not get to 95 % the end of the budget is what counts. Sigma and the rate stay
constant, or fall, for all. The error is that of the iterate. Errors below FLOOR of the start's
count as that: a program of switches is often solved exactly, and nothing can be divided by zero.
An ablation is ours with one setting changed; `published` is ZeroGrads with the paper's network and
fits: leaky ReLU, also at the output, three fits to each batch, nothing seen again.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

import smoothdiff as sd
from benchmarks._grid import Grid, Row, short
from benchmarks._summary import quarters
from benchmarks.studies.zerograds._equal import SCHEDULES, Differences, Make, Program
from benchmarks.studies.zerograds._runs import BUDGETS, FLOOR, about, curves, load, panels, sized
from smoothdiff import surrogates

PAIR = 2
PAPER = {  # how many times larger than ours an error is, by its Table 2
    "rendering": {"no-smooth": 1.2, "no-nn": 8.9, "no-local": 12.3, "fd": 24.5, "fr22": 11.0},
    "modelling": {"no-smooth": 3.9, "no-nn": 792.4, "no-local": 613.4, "fd": 654.3, "fr22": 323.6},
    "animation": {"no-smooth": 1.5, "no-nn": 16.3, "no-local": 22.4, "fd": 10.2, "fr22": 3.3},
}
GROUPS = {
    "rendering": ("brdf",),
    "modelling": ("led", "wicker", "node-graph"),
    "animation": ("rocket10", "gravity"),
}
REACHED = 0.05  # of the error of the start


class Published(eqx.Module):
    """The paper's network, whose output is activated too."""

    network: surrogates.MLP

    def __init__(self, size: int, *, key: Array):
        self.network = surrogates.MLP(size, activation=jax.nn.leaky_relu, depth=3, key=key)

    def __call__(self, u: Float[Array, " n"]) -> Float[Array, ""]:
        """The surrogate at one point."""
        return jax.nn.leaky_relu(self.network(u))


CHANGES: dict[str, dict[str, Any]] = {
    "ours": {},
    "published": {
        "surrogate": Published,
        "surrogate_steps": 3,
        "replay": 0,
        "up_to_constant": False,
    },
    "no-smooth": {"inner_sigma": 0.0},
    "no-nn": {"surrogate": surrogates.Quadratic},
    "no-local": {"local": False},
}


def methods() -> dict[str, Make]:
    """The rows of Table 2, ours first."""

    def ours(changes, problem, sigma, optim):
        return sd.ZeroGrads(sigma, num_samples=PAIR, optimizer=optim, **changes)

    changed: dict[str, Callable] = {n: partial(ours, changes) for n, changes in CHANGES.items()}
    fd = lambda problem, sigma, optim: Differences(sigma, optim)
    # nothing is subtracted, as in the paper of Fischer and Ritschel 2022
    pairs = {"num_samples": PAIR, "sampler": sd.Gaussian(antithetic=True), "baseline": "none"}
    fr22 = lambda problem, sigma, optim: sd.FirstOrder(optim, sigma, **pairs)
    return changed | {"fd": fd, "fr22": fr22}


def measure(
    starts: int, folder: Path, fresh: bool, only: Sequence[str] | None = None
) -> dict[str, Any]:
    """Curves and ratios of each task and schedule, of all rows or only some."""
    tasks = {}
    rows = {name: make for name, make in methods().items() if only is None or name in only}
    for name in BUDGETS:
        task = load(name)
        known = about(task)
        found: dict[str, Any] = {schedule: {} for schedule in SCHEDULES}
        for method, make in rows.items():
            program = Program(task, method, make, folder, fresh)
            for schedule, of in found.items():
                best = program.tuned(schedule)
                rate = best.settings["rate"]
                errors = program(schedule, rate, range(starts))
                of[method] = {"rate": rate, "tried": best.tried, "errors": errors}
        tasks[name] = known | {
            "schedules": {
                schedule: compare(of, known["evaluations"]) for schedule, of in found.items()
            }
        }
        jax.clear_caches()
    return {"tasks": tasks}


def compare(found: dict[str, dict[str, Any]], evaluations: list[int]) -> dict[str, Any]:
    """Each method's curve and its error over ours, where the median of ours is first at 5 %."""
    medians = {name: np.median(each["errors"], axis=0) for name, each in found.items()}
    down = np.flatnonzero(medians["ours"] <= REACHED)
    at = int(down[0]) if down.size else len(evaluations) - 1
    over = lambda name, at: float(max(medians[name][at], FLOOR) / max(medians["ours"][at], FLOOR))
    return {
        "at": evaluations[at],
        "reached": bool(down.size),
        "methods": {
            name: {
                "rate": each["rate"],
                "tried": each["tried"],
                "ratio": over(name, at),
                "ratio_at_end": over(name, -1),
                "final": quarters(each["errors"][:, -1]),
                "curve": quarters(each["errors"]),
            }
            for name, each in found.items()
        },
    }


def tables(results: dict[str, Any]) -> Iterator[Grid]:
    """For each schedule the ratios of the tasks; and those of groups beside the paper's."""
    tasks, starts = results["tasks"], results["starts"]
    names = list(next(iter(tasks.values()))["schedules"]["constant"]["methods"])
    for schedule in SCHEDULES:
        yield _by_task(tasks, names, schedule, starts)
    yield _by_group(tasks, names, starts)


def _by_task(tasks: dict[str, Any], names: list[str], schedule: str, starts: int) -> Grid:
    of = {name: task["schedules"][schedule] for name, task in tasks.items()}
    at = tuple(f"{each['at']}{'' if each['reached'] else '*'}" for each in of.values())
    rows = [Row("evaluations", at, end=True)]
    for name in names:
        each = [task["methods"][name] for task in of.values()]
        cells = (
            f"{short(one['ratio'])} / {short(one['ratio_at_end'])} "
            f"({short(100 * one['final'][1])} %, {one['rate']:.2g})"
            for one in each
        )
        rows.append(Row(name, tuple(cells)))
    return Grid(
        f"Error over that of ours, sigma and rate {schedule}: where ours is at 5 % / at the end",
        f"In brackets what is left at the end and the tuned rate in units of sigma. Medians over "
        f"{starts} starts. * ours does not get to 5 %: at the end of the budget.",
        ("method", *tasks),
        tuple(rows),
    )


def _by_group(tasks: dict[str, Any], names: list[str], starts: int) -> Grid:
    def mean(name: str, schedule: str, group: str) -> str:
        members = [task for task in GROUPS[group] if task in tasks]
        ratios = [tasks[t]["schedules"][schedule]["methods"][name]["ratio"] for t in members]
        return short(float(np.exp(np.mean(np.log(ratios))))) if ratios else ""

    return Grid(
        "Error over that of ours, by groups of tasks, here and in the paper",
        f"Geometric means of the ratios where ours is at 5 %, over {starts} starts; the paper's "
        "are of other scenes.",
        ("method", *(f"{g}: {s}" for g in GROUPS for s in (*SCHEDULES, "paper"))),
        tuple(
            Row(
                name,
                tuple(
                    cell
                    for group, paper in PAPER.items()
                    for cell in (
                        *(mean(name, schedule, group) for schedule in SCHEDULES),
                        short(paper[name]) if name in paper else "",
                    )
                ),
            )
            for name in names
        ),
    )


def draw(results: dict[str, Any], path: Path) -> None:
    """The curves of each task and schedule; a dotted line where the errors are compared."""
    shown = {
        f"{title}, {schedule}": (task["evaluations"], of)
        for title, task in sized(results["tasks"]).items()
        for schedule, of in task["schedules"].items()
    }
    with panels(path, shown, "Evaluations", "Error", abreast=4) as axes:
        for axis, (evaluations, of) in axes:
            found = {name: each["curve"] for name, each in of["methods"].items()}
            curves(axis, evaluations, found, FLOOR)
            axis.axvline(of["at"], color="0.4", lw=0.8, ls=":")
            axis.axhline(REACHED, color="0.4", lw=0.8, ls=":")
            axis.set(xscale="log", yscale="log", ylim=(FLOOR / 1.3, 3))
