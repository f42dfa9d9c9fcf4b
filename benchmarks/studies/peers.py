"""The shortest call of this library against every peer at its best: evaluations to 99 %.

Each peer is run at the one setting that it has for all tasks, and at the best of a grid, which is
sought for each task on starts that are not scored. Where there are residuals, those that take them
are among the peers. The shortest call is told the function, the start and the bounds, nothing else.
"""

from argparse import Namespace
from collections.abc import Iterable, Iterator
from pathlib import Path
from statistics import geometric_mean
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks import _registry
from benchmarks._grid import Grid, Row, short
from benchmarks._levels import Race
from benchmarks._style import COLOURS, figure
from benchmarks._summary import quartiles
from benchmarks._task import Method, NotAble
from benchmarks._tune import SEEDS, Tuned, tune

HELP = "the shortest call against every peer at the best of a grid"
OPTIONS = ("names", "full", "seeds", "fresh", "methods")
TASKS = {  # whether there are plateaus
    "shadow": True,
    "mug": True,
    "occlusion": True,
    "mirror": True,
    "global-illumination": True,
    "box2": True,
    "box10": True,
    "bunny": False,
    "brdf": False,
    "quad": False,
}
PEERS = (
    *("dfo_ls", "dfo_ls_noise", "least_squares", "nelder_mead", "cma_es", "optimistix_bfgs"),
    *("fr22", "wang_hvpa", "spsa", "finite_differences", "optax_perturbations"),
)
OURS = "shortest_call"
STARTS = {False: 6, True: 20}
TURNS = {False: 1, True: 3}  # of the tuning
TIE = 1.1  # a ratio up to which nobody is ahead


def measure(options: Namespace, folder: Path) -> dict[str, Any]:
    """Of each task the evaluations of each peer, untuned and tuned, and of the shortest call."""
    for name in (name for name in options.names if name not in TASKS):
        raise SystemExit(f"There is no {name!r}; choose from {', '.join(TASKS)}.")
    peers = options.methods.split(",") if options.methods else PEERS
    starts = range(options.seeds or STARTS[options.full])
    seeds, turns = (SEEDS if options.full else SEEDS[:3]), TURNS[options.full]
    found = {}
    for name in tqdm(options.names or TASKS, unit="task"):
        try:
            (task,) = _registry.family(name, False)
        except NotAble as reason:
            print(f"{name}: {reason}")
            continue
        race = Race(task, folder / "runs" / name, options.fresh)
        lines = {}
        for peer in tqdm(peers, desc=name, leave=False):
            try:
                lines[peer] = _of_peer(race, _registry.method(peer), starts, seeds, turns)
            except NotAble as reason:
                lines[peer] = {"not able": str(reason)}
        ours = _took(race(_registry.method(OURS), starts))
        found[name] = {"title": task.title, "plateau": TASKS[name], "peers": lines, "ours": ours}
    return {"starts": len(starts), "tasks": found}


def _of_peer(
    race: Race, method: Method, starts: Iterable[int], seeds: Iterable[int], turns: int
) -> dict[str, Any]:
    best: Tuned = tune(race, method, _registry.grid(method.name), list(seeds), turns)
    return {
        "title": method.title,
        "one setting": _took(race(method, list(starts))),
        "best": _took(race(method, list(starts), best.settings)),
        "settings": best.settings,
        "at the edge": best.at_the_edge,
    }


def _took(evaluations: np.ndarray) -> dict[str, Any]:
    last = evaluations[:, -1]
    return {"solved": int(np.isfinite(last).sum())} | quartiles(list(last))


def took_of(line: dict[str, Any], kind: str) -> dict[str, Any] | None:
    """What a peer took; its best is that of its one setting where that is lower after all."""
    kinds = ["one setting"] if kind == "one setting" else ["best", "one setting"]
    there = [line[each] for each in kinds if each in line and line[each]["median"] is not None]
    return min(there, key=lambda took: took["median"], default=None)


def best_peer(task: dict[str, Any], kind: str) -> tuple[str, dict[str, Any]] | None:
    """The peer with the lowest median, if any solves more than half of the starts."""
    each = ((name, took_of(line, kind)) for name, line in task["peers"].items())
    there = [(name, took) for name, took in each if took is not None]
    return min(there, key=lambda found: found[1]["median"], default=None)


def ratio(task: dict[str, Any], kind: str) -> float | None:
    """Evaluations of the best peer over ours: above 1 we are ahead; None if only one is there."""
    found = best_peer(task, kind)
    if found is None or task["ours"]["median"] is None:
        return None
    return found[1]["median"] / task["ours"]["median"]


def tables(results: dict[str, Any]) -> Iterator[Grid]:
    """All peers on each task; the best peer against ours; what that comes to."""
    starts, tasks = results["starts"], results["tasks"]
    for task in tasks.values():
        rows = [Row("The shortest call (ours)", ("", _cell(task["ours"], starts), ""), strong=True)]
        for name, line in task["peers"].items():
            if "not able" in line:
                continue
            said = ", ".join(f"{key} {short(value)}" for key, value in line["settings"].items())
            edge = f"; at the edge: {', '.join(line['at the edge'])}" if line["at the edge"] else ""
            both = (_cell(line[kind], starts) for kind in ("one setting", "best"))
            rows.append(Row(line["title"], (*both, said + edge), name))
        yield Grid(
            f"{task['title']}: evaluations to 99 % of the image error",
            f"Medians of {starts} starts, in brackets how many got there if not all.",
            ("method", "one setting", "best of a grid", "which is"),
            tuple(rows),
        )
    yield Grid(
        "The best peer of each task over the shortest call",
        _summed(tasks.values()),
        ("task", "ours", "best peer", "its evaluations", "ratio"),
        tuple(_against(task, starts) for task in tasks.values()),
    )


def _against(task: dict[str, Any], starts: int) -> Row:
    found = best_peer(task, "best")
    peer = ("-", "-") if found is None else (found[0], _cell(found[1], starts))
    return Row(task["title"], (_cell(task["ours"], starts), *peer, short(ratio(task, "best"))))


def _summed(tasks: Iterable[dict[str, Any]]) -> str:
    """Geometric means, and wins, ties and losses."""
    tasks = list(tasks)
    parts = []
    for what, chosen in (
        ("plateaus", [task for task in tasks if task["plateau"]]),
        ("all", tasks),
    ):
        found = [r for task in chosen if (r := ratio(task, "best")) is not None]
        if found:
            wins, losses = sum(r > TIE for r in found), sum(r < 1 / TIE for r in found)
            ties = len(found) - wins - losses
            parts.append(
                f"{what}: geometric mean {geometric_mean(found):.2g}, {wins} won, {ties} tied, "
                f"{losses} lost, {len(chosen) - len(found)} without a ratio"
            )
    return "; ".join(parts)


def _cell(took: dict[str, Any], starts: int) -> str:
    some = "" if took["solved"] == starts else f" ({took['solved']})"
    return short(took["median"]) + some


def draw(results: dict[str, Any], folder: Path) -> None:
    """The ratio of each task, against the best peer at one setting and at its best."""
    tasks = results["tasks"]
    with figure(folder / "peers.png", 1, 1, (7, 1 + 0.35 * len(tasks))) as (drawn, axes):
        axis = axes[0, 0]
        for kind, colour in (("one setting", COLOURS[1]), ("best", COLOURS[0])):
            found = [ratio(task, kind) for task in tasks.values()]
            places = [i for i, each in enumerate(found) if each is not None]
            values = [each for each in found if each is not None]
            axis.plot(values, places, "o", color=colour, label=f"the best peer, {kind}")
        axis.axvline(1, color="0.3", lw=0.8)
        axis.set(xscale="log", xlabel="Evaluations of the best peer over ours, to 99 %")
        names = [f"{name}{' (plateau)' if task['plateau'] else ''}" for name, task in tasks.items()]
        axis.set(yticks=range(len(tasks)), yticklabels=names, ylim=(len(tasks) - 0.5, -0.5))
        drawn.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=2)
