"""All scenes together, as tables: one line for each scene, and one for each method."""

import math
from collections.abc import Sequence

from benchmarks._grid import Grid, Row
from benchmarks._names import NAMES, is_ours, name_of
from benchmarks._reached import took
from benchmarks._summary import COSTS
from benchmarks.studies.report._compare import Tally, tally
from benchmarks.studies.report._scene import Scene
from benchmarks.studies.report._standing import amount


def overall(scenes: Sequence[Scene]) -> list[Grid]:
    """Both tables."""
    return [by_scene(scenes), by_method(scenes)]


def by_scene(scenes: Sequence[Scene]) -> Grid:
    """To 99 % of the image error: ours, and the fastest of the peers."""
    rows = []
    for scene in scenes:
        cells = [f"{scene.results['dimensions']:,}", "yes" if scene.plateaus else "no"]
        for cost in COSTS:
            best = scene.best_peer(cost)
            theirs = _median(scene, best, cost)
            rival = "-" if theirs == "-" else f"{theirs}, {name_of(best or '')}"
            if best is None and scene.peers:
                rival = "elsewhere"
            cells += [_median(scene, scene.ours, cost), rival]
        rows.append(Row(scene.label, (name_of(scene.ours or "-"), *cells)))
    return Grid(
        title="The scenes, to 99 % of the image error",
        caption="Medians; - is no more than half of the starts. The best peer is chosen for each, "
        "in seconds of those on the machine of ours; elsewhere: all ran on another.",
        columns=(
            *("scene", "ours", "parameters", "plateaus"),
            *("evaluations", "the best peer", "seconds", "the best peer"),
        ),
        rows=tuple(rows),
        numbers=False,
    )


def by_method(scenes: Sequence[Scene]) -> Grid:
    """How many times as long as ours each other method takes, over the scenes that it ran on."""
    rows = []
    for name in [each for each in NAMES if not is_ours(each)]:
        ran = [scene for scene in scenes if name in scene.ran and scene.ours]
        if ran:
            rows.append(Row(name_of(name), tuple(_cells(ran, name)), name))
    columns = ("as long", "wins/ties/losses")
    return Grid(
        title="Each peer against ours, to 99 % of the image error",
        caption="Geometric means of the ratios of medians, [95 % over scenes] (on how many of the "
        "scenes that it ran on both get there). Where quartiles overlap it is a tie. Seconds are "
        "compared where both are of the same machine.",
        columns=("method", *(f"{cost}: {column}" for cost in COSTS for column in columns)),
        rows=tuple(rows),
    )


def _cells(ran: Sequence[Scene], name: str) -> list[str]:
    cells = []
    for cost in COSTS:
        alike = [scene for scene in ran if name in scene.comparable(cost)]
        pairs = [(took(s.ran[s.ours or ""], cost), took(s.ran[name], cost)) for s in alike]
        found = tally(pairs)
        cells += [
            _mean(found, len(alike)),
            "/".join(str(found.verdicts[v]) for v in ("win", "tie", "loss")),
        ]
    return cells


def _mean(found: Tally, ran: int) -> str:
    of = found.mean
    if of is None:
        return f"- (0/{ran})" if ran else ""
    interval = f" [{of.low:.2g}, {of.high:.2g}]" if of.scenes > 1 else ""
    return f"{of.value:.2g}{interval} ({of.scenes}/{ran})"


def _median(scene: Scene, method: str | None, cost: str) -> str:
    median = took(scene.ran[method], cost).median if method else math.inf
    return amount(median, cost) if math.isfinite(median) else "-"
