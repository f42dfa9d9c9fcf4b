"""A study is a command: it measures, and what it measured is written, drawn and shown.

A module of `studies` has HELP, one line; OPTIONS, the names of the flags that it knows, of those in
`__main__.FLAGS`; `measure`, (options, folder) -> results, a dict that JSON knows, where `options`
has these flags; `draw`, (results, folder) -> None; and `tables`, results -> Grids. Pictures and
tables know nothing but the results, so that they can be made again from the file. It may have
`ending`, results -> (Grids, lines), which a run ends with in place of all tables.
"""

import json
import os
from argparse import Namespace
from collections.abc import Callable, Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

from rich.console import Console

from benchmarks._grid import Grid, to_rich
from benchmarks._machine import machine

HERE = Path(__file__).parent
COMMITTED = HERE / "results"  # what the tables of the README were made from
RUNS = HERE / "runs"  # what a user runs; git ignores it
WIDEST = 1000  # letters that a line of a table may have


def about(options: Namespace) -> dict[str, Any]:
    """What stands at the head of all results."""
    return {"command": options.said, "setting": setting(options), "machine": machine()}


def setting(options: Namespace) -> str:
    """How large it is, as results and names of files have it."""
    return "full" if getattr(options, "full", False) else "quick"


def run(
    study: ModuleType, options: Namespace, folder: Path, measure: Callable | None = None
) -> None:
    """Measures, if need be not as the study does; writes results.json and pictures, prints tables.

    The folder has the name that the results have among the committed ones.
    """
    results = write(about(options) | (measure or study.measure)(options, folder), folder)
    study.draw(results, folder)
    grids, lines = (
        study.ending(results) if hasattr(study, "ending") else (study.tables(results), [])
    )
    show(grids)
    theirs = committed(folder.name) if getattr(options, "compare", False) else None
    if theirs is not None:
        show(study.compare(results, theirs))
    for line in lines:
        Console().print(line, markup=False, highlight=False)
    Console().print(f"Written to {folder}")


def committed(name: str, results: Path | None = None) -> dict[str, Any] | None:
    """The results of a task or study, of the committed ones or in another folder, if any."""
    path = (results or COMMITTED) / name / "results.json"
    return json.loads(path.read_text()) if path.exists() else None


def show(grids: Iterable[Grid]) -> None:
    """Prints tables. A file gets all of their width; a terminal folds what it has no room for."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=WIDEST)
    for grid in grids:
        console.print(to_rich(grid))


def write(results: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Writes results.json, all or nothing, and gives what it says, with texts as keys."""
    text = json.dumps(rounded(results), separators=(",", ":"), allow_nan=False)
    folder.mkdir(parents=True, exist_ok=True)
    temporary = folder / "results.tmp"
    temporary.write_text(text + "\n")
    os.replace(temporary, folder / "results.json")
    return json.loads(text)


def rounded(tree: Any, digits: int = 4) -> Any:
    """Numbers with the digits that they deserve; what is not finite is None."""
    if isinstance(tree, float):
        return float(f"{tree:.{digits}g}") if abs(tree) < float("inf") else None
    if isinstance(tree, dict):
        return {str(key): rounded(value, digits) for key, value in tree.items()}
    return [rounded(each, digits) for each in tree] if isinstance(tree, list | tuple) else tree
