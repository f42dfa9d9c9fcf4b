"""The page of all scenes, and the same in short on the terminal; nothing is run.

`python -m benchmarks report` reads the committed results and writes the page beside them, `report
--runs` what was run here. A report of some scenes has a name of its own, beside what was run.
"""

from argparse import Namespace
from pathlib import Path

from rich.console import Console

from benchmarks import _registry, _study
from benchmarks.studies.report._compare import in_one_line
from benchmarks.studies.report._overall import overall
from benchmarks.studies.report._scene import load

HELP = "the page of all scenes, or of some, from results"
OPTIONS = ("names", "runs")
SHOWN = ("scene", "large", "network", "program")  # kinds of tasks


def run(options: Namespace, folder: Path) -> None:
    """Writes the page, and prints what it says of all scenes."""
    runs = folder.parent
    results = runs if options.runs else _study.COMMITTED
    names = options.names or [n for n, of in _registry.tasks().items() if of.kind in SHOWN]
    written = write(results, results if not options.names else runs, options.names)
    for name in names:
        if not (results / name / "results.json").exists():
            Console().print(f"{name} has no results: python -m benchmarks run {name}")
    if written is None:
        return
    scenes = [scene for name in names for scene in load(name, results)]
    _study.show(overall(scenes))
    Console().print(in_one_line(scenes), markup=False, highlight=False)
    Console().print(f"The page: {written}, {written.stat().st_size / 1e6:.1f} MB", soft_wrap=True)


def write(results: Path, folder: Path, names: list[str]) -> Path | None:
    """Writes the page of some tasks, or of all, by the folder of results; None where none ran."""
    from benchmarks.studies.report import _page

    shown = names or [n for n, of in _registry.tasks().items() if of.kind in SHOWN]
    scenes = [scene for name in shown for scene in load(name, results)]
    if not scenes:
        return None
    folder.mkdir(parents=True, exist_ok=True)
    written = folder / ("-".join(["report", *names]) + ".html")
    written.write_text(_page.page(scenes, results, whole=not names))
    return written
