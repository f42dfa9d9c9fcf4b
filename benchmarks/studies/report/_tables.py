"""The tables of the report: each scene in the layout of the paper's Table 2, then all together."""

from collections.abc import Sequence
from itertools import product
from statistics import geometric_mean

from benchmarks._grid import Grid, Row
from benchmarks._summary import COSTS
from benchmarks.studies.report._scene import ERRORS, LEVELS, OURS, Scene, all_methods, title

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
    goals = list(product(ERRORS, LEVELS))
    rows = []
    for name in sorted(scene.ran, key=lambda name: (name != scene.ours, name not in OURS)):
        found = scene.ran[name]
        cells = (_cell(scene, name, error, level, cost) for error, level in goals)
        row = Row(found["title"], (str(found["starts"]), *cells), name, name == scene.ours)
        rows.append(row)
    return Grid(
        title=f"{scene.name}: {cost}, as ratios to ours",
        caption=EXPLAINED if cost == COSTS[0] else "",
        columns=("method", "runs", *(f"{SHORT[error]} {level} %" for error, level in goals)),
        rows=tuple(rows),
    )


def _cell(scene: Scene, method: str, error: str, level: str, cost: str) -> str:
    median, solved, starts = scene.reached(method, error, level, cost)
    some = f"({solved})" if 0 < solved < starts else ""
    if median is None:
        return some
    ratio = scene.ratio(method, scene.ours, error, level, cost)
    taken = amount(median, cost)
    shown = f"={taken}" if ratio is None else f"{ratio:.2f}"
    if method == scene.ours:
        shown = f"1 [{taken}]"
    return f"{shown} {some}".rstrip()


def amount(median: float | None, cost: str) -> str:
    """A median with its unit, or a dash."""
    if median is None:
        return "-"
    digits = f"{median:.0f}" if cost == "evaluations" or median >= 100 else f"{median:.2g}"
    return digits + UNITS[cost]


def over(scenes: Sequence[Scene], which: str) -> Grid:
    """Geometric means over scenes of the ratios to ours, for each method."""
    columns = list(product(COSTS, LEVELS))
    rows = []
    for name in all_methods(scenes):
        ran, cells = [scene for scene in scenes if name in scene.ran], []
        for cost, level in columns:
            ratios = ratios_to_ours(ran, name, level, cost)
            mean = f"{geometric_mean(ratios):.2f} " if ratios else ""
            cells.append(f"{mean}({len(ratios)}/{len(ran)})")
        rows.append(Row(title(name, scenes), tuple(cells), name, name in OURS))
    return Grid(
        title=f"Times as long as ours, {which}",
        caption="Geometric means of the ratios of medians, to a reduction of the image error, over "
        "scenes where both reach it; in brackets on how many of those that the method was "
        "run on. Scenes that a method does not solve are not in its mean.",
        columns=("method", *(f"{cost} {level} %" for cost, level in columns)),
        rows=tuple(rows),
    )


def ratios_to_ours(scenes: Sequence[Scene], method: str, level: str, cost: str) -> list[float]:
    """One for each scene where both reach the level of the image error."""
    found = (scene.ratio(method, scene.ours, "image_error", level, cost) for scene in scenes)
    return [ratio for ratio in found if ratio is not None]


def of_scenes(scenes: Sequence[Scene]) -> Grid:
    """One row for each scene: ours, and the fastest of the others to 99 %."""
    rows = []
    for scene in scenes:
        setting, ours = scene.about["setting"], scene.ours
        if ours is None:
            rows.append(Row(scene.name, (setting, "none ran", "", "", "", "")))
            continue
        took = {cost: scene.reached(ours, "image_error", "99", cost) for cost in COSTS}
        both = (f"{amount(at.median, c)} | {_runner_up(scene, c)}" for c, at in took.items())
        solved = took["evaluations"]
        plateau = "yes" if scene.plateau else "no"
        cells = (setting, ours, plateau, *both, f"{solved.solved}/{solved.starts}")
        rows.append(Row(scene.name, cells))
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
    took = ((scene.reached(name, "image_error", "99", cost).median, name) for name in rivals)
    there = [(median, name) for median, name in took if median is not None]
    median, name = min(there, key=lambda each: each[0], default=(None, ""))
    return "-" if median is None else f"{amount(median, cost)}, {name}"
