"""What the savings of the scenes are worth in seconds: a table."""

from collections.abc import Sequence
from typing import Any

from benchmarks.report._grid import Grid, Row
from benchmarks.report._scene import Scene
from benchmarks.report._tables import amount
from benchmarks.scenes._dearer import SAVINGS

# of ours, by what they know of the loss
FIRST = ("first_order", "local_gradient", "local_first_order")
SECOND = ("newton_cg", "gauss_newton", "local_gauss_newton")


def table(results: dict[str, Any], scenes: Sequence[Scene]) -> Grid:
    """What each saving is worth, for the scenes that were timed.

    Args:
        results: What `python -m benchmarks savings` has written.
        scenes: What was run on them, where anything was.
    """
    ran = {scene.name: scene for scene in scenes}
    rows = []
    for name, found in results["scenes"].items():
        each, scene = found["milliseconds"], ran.get(name)
        number = None
        if scene is not None and scene.ours is not None:
            number = scene.reached(scene.ours, "image_error", "99", "evaluations").median
        cells = [
            f"{each[''] / 1e3 * number:.2g} s" if number else "-",
            f"{each['']:.1f} ms",
            *(_worth(each[saving], each[""], number) for saving in SAVINGS),
            *(_fastest(scene, order) for order in (FIRST, SECOND)),
        ]
        rows.append(Row(name, tuple(cells)))
    return Grid(
        title="What the savings are worth",
        caption=(
            "Seconds that the renders of ours take to 99 % of the image error; how many more they "
            "would take without a saving, if there were as many of them; and in brackets, how many "
            "times as long. At the end, what a whole run to 99 % took when it was made: by the "
            "fastest of ours that use first derivatives, and of those that use second ones."
        ),
        columns=("scene", "renders", "one", *SAVINGS.values(), "first order", "second order"),
        rows=tuple(rows),
    )


def _worth(dear: float, cheap: float, number: float | None) -> str:
    ratio = f"({dear / cheap:.2g})"
    return f"{(dear - cheap) / 1e3 * number:.2g} s {ratio}" if number else ratio


def _fastest(scene: Scene | None, methods: Sequence[str]) -> str:
    if scene is None:
        return "-"
    took = [
        reached
        for name in methods
        if name in scene.ran
        and (reached := scene.reached(name, "image_error", "99", "seconds")).median is not None
    ]
    return amount(min(took), "seconds") if took else "-"
