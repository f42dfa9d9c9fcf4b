"""The studies as one picture: two rows for each scene, and as a table."""

from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.table import Table

from benchmarks._report import show
from benchmarks._style import figure, legend, looks

AXES = {
    "samples": "Evaluations of a step",
    "spp": "Samples of a pixel",
    "jpeg": "JPEG: RMS error, %",
}
BINS = 4  # of starts, by how far they are away
SOLVED = 0.1  # of sigma: nearer than this is found

Results = dict[str, Any]


def draw(results: Results, path: Path) -> None:
    """Success and the final distance against the start's; costs and distance in each study."""
    scenes = results["scenes"]
    titles = results["titles"]
    look = {name: line | {"marker": "o", "ms": 3} for name, line in looks(titles).items()}
    with figure(path, 2 * len(scenes), 4, (13, 5 * len(scenes))) as (drawn, axes):
        for i, (scene, studies) in enumerate(scenes.items()):
            above, below = axes[2 * i], axes[2 * i + 1]
            _starts(above[0], below[0], studies["starts"], look)
            above[0].set_title(scene)
            for column, (study, label) in enumerate(AXES.items(), start=1):
                _study(above[column], below[column], studies[study], look)
                below[column].set_xlabel(label)
        handles = [axes[0, 0].plot([], [], **look[name])[0] for name in titles]
        legend(drawn, handles, list(titles.values()))


def _starts(above, below, methods: dict[str, list[dict[str, Any]]], look: dict) -> None:
    """Of starts that are about as far away, how many are solved; and where each one ends."""
    for name, (found,) in methods.items():
        begun, ended = np.asarray(found["begun"]), np.asarray(found["ended"])
        bins = np.array_split(np.argsort(begun), BINS)
        share = [np.mean(ended[b] < SOLVED) for b in bins]
        above.plot([np.median(begun[b]) for b in bins], share, **look[name])
        below.plot(begun, ended, ls="none", color=look[name]["color"], marker="o", ms=3)
    above.set(ylim=(-0.05, 1.05), ylabel=f"Share that ends within {SOLVED} sigma")
    below.set(yscale="log", xlabel="Distance of the start, in sigma", ylabel="Final distance")
    below.axhline(SOLVED, color="0.6", lw=0.6, ls=":")


def _study(above, below, methods: dict[str, list[dict[str, Any]]], look: dict) -> None:
    """Medians and quartiles over the starts; a median that is not there is not drawn."""
    for name, found in methods.items():
        for axis, what in ((above, "evaluations"), (below, "distance")):
            values = [line["value"] for line in found]
            low, middle, high = (
                np.array([line[what][part] for line in found], float)
                for part in ("lower", "median", "upper")
            )
            axis.plot(values, middle, **look[name])
            axis.fill_between(values, low, high, color=look[name]["color"], alpha=0.15, lw=0)
    above.set(yscale="log", ylabel="Evaluations to 90 %")
    below.set(yscale="log", ylabel="Final distance, in sigma")
    below.axhline(SOLVED, color="0.6", lw=0.6, ls=":")


def table(results: Results) -> Table:
    """All numbers, for the terminal."""
    shown = Table(
        title=f"Robustness ({results['setting']})",
        caption=(
            "Median \\[quartiles] to 90 % of the parameter error, and the final distance in units "
            f"of sigma; solved ends within {SOLVED}. - is not reached."
        ),
        box=box.SIMPLE_HEAD,
    )
    for column in ("scene", "study", "value", "method"):
        shown.add_column(column)
    for column in ("evaluations", "seconds", "final distance", "solved"):
        shown.add_column(column, justify="right", no_wrap=True)
    for scene, studies in results["scenes"].items():
        for study, methods in studies.items():
            for name, found in methods.items():
                for line in found:
                    what = (show(line[part]) for part in ("evaluations", "seconds", "distance"))
                    value = "" if study == "starts" else str(line["value"])
                    solved = f"{sum(end < SOLVED for end in line['ended'])}/{len(line['ended'])}"
                    shown.add_row(scene, study, value, name, *what, solved)
            shown.add_section()
    return shown
