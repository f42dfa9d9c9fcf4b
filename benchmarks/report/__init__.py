"""The report of the scenes: one page, and the same tables on the terminal; nothing is run.

`python -m benchmarks report` reads what `python -m benchmarks run all` has written so far.
"""

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from benchmarks import tasks
from benchmarks._task import NotAble, precision_of
from benchmarks.report import _atlas, _page, _tables
from benchmarks.report._grid import to_rich
from benchmarks.report._scene import load, names


def main(results: Path, asked: Sequence[str] = ()) -> None:
    """Writes report.html into the folder of results, and prints its tables.

    Args:
        results: The folder with a folder for each task.
        asked: The tasks; all scenes by default.
    """
    console = Console()
    scenes = []
    for name in names(asked):
        scene = load(name, results)
        if scene is None:
            console.print(f"{name} has no results: python -m benchmarks run {name}")
            continue
        scenes.append(scene)
        _render_missing(name, scene.results, results / name)
    if not scenes:
        return
    overall = _page.overall(scenes)
    for grid in (*(grid for scene in scenes for grid in _tables.of_scene(scene)), *overall):
        console.print(to_rich(grid))
    written = results / "report.html"
    written.write_text(_page.page(scenes, overall, results))
    console.print(f"Written to {written}, {written.stat().st_size / 1e6:.1f} MB")


def _render_missing(name: str, results: dict, folder: Path) -> None:
    """Renders the pictures of results that are older than pictures are."""
    if _atlas.load(results, folder) is not None:
        return
    try:
        task = tasks.module(name).build(results["setting"] == "full")
    except NotAble:
        return
    if task.image is not None:
        with precision_of(task):
            _atlas.store(task, results, folder)
