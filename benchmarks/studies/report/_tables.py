"""The tables of the report: each scene in the layout of the paper's Table 2, then all together."""

import math
from collections.abc import Iterable, Sequence

from benchmarks._grid import Grid, Row
from benchmarks._summary import COSTS
from benchmarks.studies.report._scene import (
    ERRORS,
    LEVELS,
    OURS,
    Reached,
    Scene,
    all_methods,
    title,
)

SHORT = {"image_error": "image", "parameter_error": "param."}
UNITS = {"evaluations": "", "seconds": " s"}
EXPLAINED = (
    "Medians. The first row is ours, with what it took in brackets. A blank is a level that no "
    "more than half of the starts reach; (n) is how many did, where not all. Where ours does not "
    "reach a level, = gives what others took."
)


def of_scene(scene: Scene) -> list[Grid]:
    """Table 2's layout, once for evaluations and once for seconds."""
    return [_of_scene(scene, cost) for cost in COSTS]


def _of_scene(scene: Scene, cost: str) -> Grid:
    ours = scene.ours
    order = sorted(scene.ran, key=lambda name: name not in OURS)
    order.sort(key=lambda name: name != ours)
    return Grid(
        title=f"{scene.name}: {cost}, as ratios to ours",
        caption=EXPLAINED if cost == COSTS[0] else "",
        columns=("method", "runs", *(f"{SHORT[e]} {level} %" for e in ERRORS for level in LEVELS)),
        rows=tuple(
            Row(
                name=scene.ran[name]["title"],
                cells=(
                    str(scene.ran[name]["starts"]),
                    *(_cell(scene, name, e, level, cost) for e in ERRORS for level in LEVELS),
                ),
                method=name,
                strong=name == ours,
            )
            for name in order
        ),
    )


def _cell(scene: Scene, method: str, error: str, level: str, cost: str) -> str:
    reached = scene.reached(method, error, level, cost)
    some = f"({reached.solved})" if 0 < reached.solved < reached.starts else ""
    if reached.median is None:
        return some
    ratio = scene.ratio(method, scene.ours, error, level, cost)
    taken = amount(reached, cost)
    shown = f"={taken}" if ratio is None else f"{ratio:.2f}"
    if method == scene.ours:
        shown = f"1 [{taken}]"
    return f"{shown} {some}".rstrip()


def amount(reached: Reached, cost: str) -> str:
    """A median with its unit, or a dash."""
    median = reached.median
    if median is None:
        return "-"
    digits = f"{median:.0f}" if cost == "evaluations" or median >= 100 else f"{median:.2g}"
    return digits + UNITS[cost]


def over(scenes: Sequence[Scene], which: str) -> Grid:
    """Geometric means over scenes of the ratios to ours, for each method."""
    columns = [(cost, level) for cost in COSTS for level in LEVELS]
    return Grid(
        title=f"Times as long as ours, {which}",
        caption=(
            "Geometric means of the ratios of medians, to a reduction of the image error, over "
            "scenes where both reach it; in brackets on how many of those that the method was "
            "run on. Scenes that a method does not solve are not in its mean."
        ),
        columns=("method", *(f"{cost} {level} %" for cost, level in columns)),
        rows=tuple(
            Row(
                name=title(name, scenes),
                cells=tuple(_mean_cell(scenes, name, level, cost) for cost, level in columns),
                method=name,
                strong=name in OURS,
            )
            for name in all_methods(scenes)
        ),
    )


def _mean_cell(scenes: Sequence[Scene], method: str, level: str, cost: str) -> str:
    ran = [scene for scene in scenes if method in scene.ran]
    ratios = ratios_to_ours(ran, method, level, cost)
    return (
        f"{geometric_mean(ratios):.2f} ({len(ratios)}/{len(ran)})" if ratios else f"(0/{len(ran)})"
    )


def ratios_to_ours(scenes: Sequence[Scene], method: str, level: str, cost: str) -> list[float]:
    """One for each scene where both reach the level of the image error."""
    found = (scene.ratio(method, scene.ours, "image_error", level, cost) for scene in scenes)
    return [ratio for ratio in found if ratio is not None]


def geometric_mean(ratios: Iterable[float]) -> float:
    logs = [math.log(ratio) for ratio in ratios]
    return math.exp(sum(logs) / len(logs))


def of_scenes(scenes: Sequence[Scene]) -> Grid:
    """One row for each scene: ours, and the fastest of the others to 99 %."""
    rows = []
    for scene in scenes:
        if scene.ours is None:
            rows.append(Row(scene.name, (scene.about["setting"], "none ran", "", "", "", "")))
            continue
        cells = [scene.about["setting"], scene.ours, "yes" if scene.plateau else "no"]
        for cost in COSTS:
            at = scene.reached(scene.ours, "image_error", "99", cost)
            cells.append(f"{amount(at, cost)} | {_runner_up(scene, cost)}")
        solved = scene.reached(scene.ours, "image_error", "99", "evaluations")
        cells.append(f"{solved.solved}/{solved.starts}")
        rows.append(Row(scene.name, tuple(cells)))
    return Grid(
        title="The scenes",
        caption="To 99 % of the image error, ours | the fastest of the others; runs of ours.",
        columns=("scene", "setting", "ours", "plateau", *COSTS, "reached"),
        rows=tuple(rows),
        numbers=False,
    )


def _runner_up(scene: Scene, cost: str) -> str:
    """The fastest to 99 % of the image error of all that are not ours."""
    rivals = (name for name in scene.ran if name not in OURS)
    took = {name: scene.reached(name, "image_error", "99", cost) for name in rivals}
    there = {name: at for name, at in took.items() if at.median is not None}
    best = min(there, key=lambda name: there[name].median or 0, default=None)
    return "-" if best is None else f"{amount(there[best], cost)}, {best}"
