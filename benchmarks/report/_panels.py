"""Convergence of a scene: a picture for each error and each cost, that can be read on a phone."""

import io

from PIL import Image

from benchmarks._report import LABELS, ours_of, panel
from benchmarks._style import STYLE, looks, plt
from benchmarks.report._atlas import png_uri
from benchmarks.report._scene import COSTS, ERRORS, OURS, Scene, all_methods

SIZE = (4.6, 3.3)  # inches
DPI = 130
COLOURS = 64  # of the file: lines on white need no more
SVG_DASHES = {"-": "", "--": "6 3", "-.": "6 2 1.5 2", (0, (1, 1)): "1.5 1.5"}
OTHER_DASH = "7 1.5 1.5 1.5 1.5 1.5"

Look = dict[str, dict]


def look_of(scenes) -> Look:
    """The same line for a method in every scene."""
    ran = {name: found for scene in scenes for name, found in scene.ran.items()}
    # a scene has few of ours: those that the rule names have colours of their own there
    ours = sorted(ours_of(ran), key=lambda name: (*OURS, name).index(name))
    return looks(all_methods(scenes), ours)


def swatches(look: Look) -> dict[str, str]:
    """A piece of each method's line, as SVG for the page."""
    return {name: _swatch(line["color"], line["linestyle"]) for name, line in look.items()}


def _swatch(color: str, linestyle) -> str:
    dash = SVG_DASHES.get(linestyle, OTHER_DASH)
    return (
        '<svg class=swatch viewBox="0 0 30 8" aria-hidden=true><line x1=0 y1=4 x2=30 y2=4 '
        f'stroke="{color}" stroke-width=2.5 stroke-dasharray="{dash}"/></svg>'
    )


def panels(scene: Scene, look: Look) -> list[tuple[str, str]]:
    """What each picture shows, and the picture as the source of an <img>."""
    shown = []
    for error in ERRORS:
        for cost in COSTS:
            with plt.rc_context(STYLE):
                drawn, axis = plt.subplots(figsize=SIZE)
                panel(axis, scene.ran, look, error, cost, {scene.ours})
                written = io.BytesIO()
                drawn.savefig(written, format="png", dpi=DPI)
                plt.close(drawn)
            shown.append((f"{LABELS[error]}, against {cost}", _small(written)))
    return shown


def _small(written: io.BytesIO) -> str:
    smaller = io.BytesIO()
    with Image.open(written) as drawn:
        drawn.convert("RGB").quantize(COLOURS).save(smaller, "png", optimize=True)
    return png_uri(smaller.getvalue())
