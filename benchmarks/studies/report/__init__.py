"""The report of the scenes: one page, and the same tables on the terminal; nothing is run.

`python -m benchmarks report` reads the committed results, `report --runs` what was run here. Both
write into the folder of runs; a report of some scenes has a name of its own.
"""

from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from benchmarks import _registry, _study
from benchmarks._grid import Grid
from benchmarks.studies.report import _tables
from benchmarks.studies.report._scene import Scene, load

HELP = "the page of all scenes, or of some, from results"
OPTIONS = ("names", "runs")


def run(options: Namespace, folder: Path) -> None:
    """Writes the page beside the folder, and prints its tables."""
    from benchmarks.studies.report import _page

    runs = folder.parent
    results = runs if options.runs else _study.COMMITTED
    found = {name: load(name, results) for name in options.names or _registry.scenes()}
    for name in (name for name, scene in found.items() if scene is None):
        Console().print(f"{name} has no results: python -m benchmarks run {name}")
    scenes = [scene for scene in found.values() if scene is not None]
    if not scenes:
        return
    overall = overall_of(scenes)
    _study.show([*(grid for scene in scenes for grid in _tables.of_scene(scene)), *overall])
    runs.mkdir(parents=True, exist_ok=True)
    written = runs / ("-".join(["report", *options.names]) + ".html")
    written.write_text(_page.page(scenes, overall, results))
    Console().print(f"Written to {written}, {written.stat().st_size / 1e6:.1f} MB")


def overall_of(scenes: Sequence[Scene]) -> list[Grid]:
    """The tables of all scenes together."""
    grids = [_tables.of_scenes(scenes), _tables.over(scenes, "all scenes")]
    if len({scene.plateau for scene in scenes}) > 1:
        for plateau, which in ((True, "scenes with plateaus"), (False, "scenes without")):
            some = [scene for scene in scenes if scene.plateau == plateau]
            grids.append(_tables.over(some, which))
    return grids
