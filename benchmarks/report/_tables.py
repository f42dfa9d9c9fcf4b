"""The tables of the report: each scene in the layout of the paper's Table 2, then all together."""

import math
from collections.abc import Iterable, Sequence

from benchmarks.report import _paper
from benchmarks.report._grid import Grid, Row
from benchmarks.report._scene import (
    COSTS,
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
PUBLISHED = "our_hvpa"  # what the paper's ratios are to


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


def beside_the_paper(scenes: Sequence[Scene]) -> Grid | None:
    """Ratios of seconds to OurHVPA's: measured here, and Table 2's; on the scenes of both."""
    common = [s for s in scenes if s.name in _paper.TABLE_2 and PUBLISHED in s.ran]
    if not common:
        return None
    rows = [_paper_row(common, name, name, _paper.TITLES[name]) for name in _paper.TITLES]
    return Grid(
        title="Seconds over those of OurHVPA, here and in the paper",
        caption=(
            f"Geometric means, image error; in brackets over how many of {len(common)} scenes: "
            f"{', '.join(scene.name for scene in common)}. The paper says that OurHVPA is "
            f"{_paper.AVERAGE} times as fast as the others, on average across tasks and methods. "
            "Below 1 is faster than OurHVPA. The paper tuned each method on each task; here each "
            "has one setting."
        ),
        columns=(
            "method",
            *(f"{where} {level} %" for level in _paper.LEVELS for where in ("here", "paper")),
        ),
        rows=(*rows, _paper_row(common, None, None, "Ours, by the rule")),
    )


def _paper_row(common: Sequence[Scene], here: str | None, there: str | None, name: str) -> Row:
    cells = []
    for i, level in enumerate(_paper.LEVELS):
        measured = [
            scene.ratio(here or scene.ours or "", PUBLISHED, "image_error", level, "seconds")
            for scene in common
        ]
        printed = [
            1.0
            if there == PUBLISHED
            else _paper.TABLE_2[scene.name].get(there or "", (None,) * 2)[i]
            for scene in common
        ]
        for ratios in (measured, printed):
            known = [ratio for ratio in ratios if ratio is not None]
            cells.append(f"{geometric_mean(known):.2f} ({len(known)})" if known else "")
    return Row(name, tuple(cells), here, strong=here is None)


def of_scenes(scenes: Sequence[Scene]) -> Grid:
    """One row for each scene: ours, and the fastest of the others to 99 %."""
    rows = []
    for scene in scenes:
        if scene.ours is None:
            rows.append(Row(scene.name, (scene.results["setting"], "none ran", "", "", "", "")))
            continue
        cells = [scene.results["setting"], scene.ours, "yes" if scene.plateau else "no"]
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
    found = fastest_rival(scene, cost)
    if found is None:
        return "-"
    name, reached = found
    return f"{amount(reached, cost)}, {name}"


def fastest_rival(
    scene: Scene, cost: str, without: Sequence[str] = ()
) -> tuple[str, Reached] | None:
    """The fastest to 99 % of the image error of all that are not ours."""
    rivals = [name for name in scene.ran if name not in (*OURS, *without)]
    took = {name: scene.reached(name, "image_error", "99", cost) for name in rivals}
    there = [name for name in rivals if took[name].median is not None]
    best = min(there, key=lambda name: took[name].median or 0, default=None)
    return None if best is None else (best, took[best])
