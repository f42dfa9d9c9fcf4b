"""The methods of the paper on higher-order rendering on its own tasks, at its own settings.

For each task: what the paper says; the same method here at the settings of its Table 3; CMA-ES; and
the shortest call of this library. With --tuned also Fischer-FR22, Wang-HVPA and CMA-ES at the best
of a grid, which is sought on starts that are not scored. Fischer-FR22 at ever larger rates, and all
else as in the table, shows how much of its time is the way to go over the rate.
"""

from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks import _registry
from benchmarks._grid import Grid, Row, short
from benchmarks._levels import Race
from benchmarks._style import COLOURS, headed, panels
from benchmarks._summary import quartiles
from benchmarks._task import NotAble, Task
from benchmarks._tune import SEEDS, tune
from benchmarks.studies.papers.table import CMA_ES, NAMES, PUBLISHED, evaluations, settings
from benchmarks.studies.papers.tasks import TASKS, UNITS

HELP = "the higher-order-rendering paper's methods on its own tasks, as its authors ran them"
OPTIONS = ("names", "full", "seeds", "tuned", "fresh")
STARTS = {False: 5, True: 20}
TUNED = ("fischer_fr22", "wang_hvpa")
TURNS = {False: 1, True: 3}  # of the tuning
FASTER = (1, 4, 16, 64)  # times the table's rate
BASE = "wang_hvpa"
LEVELS = ("90", "99")
DEAREST = 2000  # evaluations of an iteration; dearer methods run with --full only


def measure(options: Namespace, folder: Path) -> dict[str, Any]:
    """Evaluations to 90 and 99 % of the image error, of each method on each task."""
    unknown = [name for name in options.names if name not in TASKS]
    if unknown:
        raise SystemExit(f"There is no {unknown[0]!r}; choose from {', '.join(TASKS)}.")
    starts = range(options.seeds or STARTS[options.full])
    found = {}
    for name in tqdm(options.names or TASKS, unit="task"):
        try:
            task = TASKS[name]()
        except NotAble as reason:
            print(f"{name}: {reason}")
            continue
        found[name] = _measure(task, Race(task, folder / "runs" / name, options.fresh), options)
    return {"starts": len(starts), "tasks": found}


def _measure(task: Task, race: Race, options: Namespace) -> dict[str, Any]:
    starts = range(options.seeds or STARTS[options.full])
    seeds, turns = (SEEDS if options.full else SEEDS[:3]), TURNS[options.full]
    unit, n = UNITS.get(task.name, 1.0), int(np.size(task.score.reference))
    methods = {}
    for name, row in PUBLISHED[task.name].rows.items():
        of_iteration = evaluations(task.name, name, n)
        line: dict[str, Any] = {
            "paper": row.ratio,
            "logs": [of_iteration * count if count else None for count in row.iterations],
        }
        if of_iteration <= DEAREST or options.full:
            said, method = settings(task.name, name, unit), _registry.method(name)
            line["published"] = _took(race(method, starts, said))
            if name in TUNED and options.tuned:
                best = tune(race, method, _around(said), seeds, turns, said)
                line["best"] = _took(race(method, starts, best.settings))
                line["settings"], line["at the edge"] = best.settings, best.at_the_edge
        methods[name] = line
    cma_es = _registry.method("cma_es")
    line = {"paper": CMA_ES[task.name], "published": _took(race(cma_es, starts))}
    if options.tuned:
        best = tune(race, cma_es, _registry.grid("cma_es"), seeds, turns)
        line["best"] = _took(race(cma_es, starts, best.settings))
        line["settings"], line["at the edge"] = best.settings, best.at_the_edge
    methods["cma_es"] = line
    ours = race(_registry.method("shortest_call"), starts)
    methods["shortest_call"] = {"published": _took(ours)}
    said, fr22 = settings(task.name, "fischer_fr22", unit), _registry.method("fischer_fr22")
    faster = [
        {"times": k, "took": _took(race(fr22, starts, said | {"rate": k * said["rate"]}))}
        for k in FASTER
    ]
    return {"title": task.title, "lines": methods, "faster": faster}


def _around(said: dict[str, Any]) -> dict[str, list[float]]:
    """The grid of a method: its settings in the table are in the middle."""
    if "rate" in said:
        fall = [max(said["fall"] // k, 1) for k in (16, 4, 1)]
        return {"rate": [said["rate"] * k for k in (1, 4, 16)], "fall": fall}
    counts = {"pairs": said["pairs"], "line_search": said["line_search"]}
    near = {name: sorted({max(v // 2, 1), v, 2 * v}) for name, v in counts.items()}
    return {"trust": [said["trust"] * k for k in (0.25, 0.5, 1.0)]} | near


def _took(evaluations: np.ndarray) -> dict[str, Any]:
    """Quartiles of each level, and from how many starts it was reached."""
    return {
        level: {"solved": int(np.isfinite(column).sum())} | quartiles(list(column))
        for level, column in zip(LEVELS, evaluations.T, strict=True)
    }


def ratio(task: dict[str, Any], name: str, level: str, kind: str = "published") -> float | None:
    """Of the medians of a method and of Wang-HVPA, both at their settings of that kind."""
    mine, base = (task["lines"][each].get(kind) for each in (name, BASE))
    if mine is None or base is None or None in (mine[level]["median"], base[level]["median"]):
        return None
    return mine[level]["median"] / base[level]["median"]


def tables(results: dict[str, Any]) -> Iterator[Grid]:
    """The methods of each task, and what larger rates do."""
    yield Grid(
        "As published: evaluations to 90 / 99 % of the image error",
        f"Medians of {results['starts']} starts, in brackets how many got there if not all. Ratios "
        "are to Wang-HVPA: the paper's in seconds, its logs' in evaluations at most, ours in "
        "evaluations at the paper's settings. * a best setting at the end of its grid.",
        ("", "paper", "its logs", "ours, ratio", "ours, evaluations", "at its best"),
        tuple(row for task in results["tasks"].values() for row in _rows(task, results["starts"])),
    )
    yield Grid(
        "Fischer-FR22 at larger rates: evaluations to 90 % of the image error",
        "Times the rate of Table 3; all else as there. Last, Wang-HVPA at the paper's settings.",
        ("", *(f"{k} x" for k in FASTER), NAMES[BASE]),
        tuple(
            Row(
                task["title"],
                (
                    *(_cell(each["took"]["90"], results["starts"]) for each in task["faster"]),
                    _cell(task["lines"][BASE].get("published", {}).get("90"), results["starts"]),
                ),
            )
            for task in results["tasks"].values()
        ),
    )


def _rows(task: dict[str, Any], starts: int) -> Iterator[Row]:
    logs = task["lines"][BASE]["logs"]
    yield Row(task["title"], ("",) * 5, strong=True)
    titles = NAMES | {"cma_es": "CMA-ES (pycma)", "shortest_call": "the shortest call (ours)"}
    for name, line in task["lines"].items():
        pairs = zip(line.get("logs", ()), logs, strict=False)
        said = [mine / base if mine and base else None for mine, base in pairs]
        edge = "*" if line.get("at the edge") else ""
        cells = (
            " / ".join(map(short, line["paper"])) if "paper" in line else "",
            " / ".join(map(short, said)) if "logs" in line else "",
            " / ".join(short(ratio(task, name, level)) for level in LEVELS),
            _both(line.get("published"), starts),
            _both(line.get("best"), starts) + edge,
        )
        yield Row("  " + titles[name], cells, end=name == "shortest_call")


def _both(took: dict[str, Any] | None, starts: int) -> str:
    return "" if took is None else " / ".join(_cell(took[level], starts) for level in LEVELS)


def _cell(took: dict[str, Any] | None, starts: int) -> str:
    if took is None:
        return ""
    some = "" if took["solved"] == starts else f" ({took['solved']})"
    return short(took["median"]) + some


def draw(results: dict[str, Any], folder: Path) -> None:
    """A panel for each task: evaluations to 99 %, medians from quartile to quartile."""
    tasks = results["tasks"]
    looks = (("published", 0), ("best", 1))
    titles = [task["title"] for task in tasks.values()]
    with panels(folder / "papers.png", titles, 2, (4.6, 2.7)) as (drawn, axes):
        for axis, task in zip(axes.flat, tasks.values(), strict=False):
            names, most = list(task["lines"]), _most(task)
            for kind, colour in looks:
                for place, name in enumerate(names):
                    took = task["lines"][name].get(kind, {}).get("99")
                    if took is None or took["median"] is None:
                        continue
                    here = place + 0.16 * (2 * colour - 1)
                    ends = [took["lower"], took["upper"] or most]
                    axis.hlines(here, *ends, color=COLOURS[colour], lw=4, alpha=0.4)
                    axis.plot(took["median"], here, "o", color=COLOURS[colour], ms=4)
            shown = NAMES | {"cma_es": "CMA-ES", "shortest_call": "shortest call"}
            axis.set(yticks=range(len(names)), yticklabels=[shown[name] for name in names])
            axis.set(xscale="log", ylim=(len(names) - 0.5, -0.5))
            axis.set_xlim(right=most)
        for kind, colour in looks:
            label = "at the paper's settings" if kind == "published" else "at its best"
            axes.flat[0].plot([], [], "o", color=COLOURS[colour], label=label)
        drawn.legend(*axes.flat[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
        headed(drawn, "Evaluations to 99 % of the image error: medians, from quartile to quartile")


def _most(task: dict[str, Any]) -> float:
    """A right end of the axis: beyond all numbers; what has no upper quartile goes on to it."""
    kinds = [
        line[kind]
        for line in task["lines"].values()
        for kind in ("published", "best")
        if kind in line
    ]
    return 3 * max(took["99"][q] or 0 for took in kinds for q in ("median", "upper"))
