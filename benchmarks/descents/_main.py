"""Runs descents, writes results.json and the pictures, and shows the tables."""

import json
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from benchmarks.descents import _pictures, _report
from benchmarks.descents._descent import Descent
from benchmarks.descents._runs import run_all


def run(built: Descent | Sequence[Descent], options: Namespace, folder: Path, command: str) -> None:
    """Runs one descent, or several that belong together, each into a folder of its own.

    Args:
        built: What `build` of a task gives.
        options: The command line's: full, seeds and fresh.
        folder: Where the results go.
        command: The command line, for the results.
    """
    runs = folder / "runs"
    if isinstance(built, Descent):
        _run(built, options, folder, runs, command)
    else:
        for descent in built:
            _run(descent, options, folder / descent.name, runs, command)


def _run(descent: Descent, options: Namespace, folder: Path, runs: Path, command: str) -> None:
    setting = "full" if options.full else "quick"
    found = run_all(
        descent,
        options.seeds or descent.seeds,
        runs,
        fresh=options.fresh,
        progress=True,
    )
    folder.mkdir(parents=True, exist_ok=True)
    results = _report.summarise(descent, found, setting, command)
    if descent.also is not None:
        results["also"] = descent.also(folder)
    (folder / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    _pictures.write(descent, found, results, folder)
    console = Console()
    console.print(_report.tables(results))
    console.print(f"Written to {folder}")
