"""The command line: `python -m benchmarks list | run TASK... | draw NAME... | overhead | ...`."""

import argparse
import json
import sys
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks import _registry, _run, _study
from benchmarks._task import NotAble

FLAGS: dict[str, dict] = {
    "full": {"action": "store_true", "help": "every start, at full size"},
    "seeds": {"type": int, "metavar": "N", "help": "number of starts"},
    "fresh": {"action": "store_true", "help": "run again what has been run"},
    "methods": {"metavar": "A,B", "help": "these, separated by commas"},
    "compare": {"action": "store_true", "help": "show the committed results too"},
    "runs": {"action": "store_true", "help": "of what was run here, not of what is committed"},
}


def parser() -> argparse.ArgumentParser:
    """What can be said on the command line."""
    said = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    commands = said.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="name the tasks and the methods")
    run = commands.add_parser("run", help="run methods on tasks; what has been run is kept")
    names = [*_registry.tasks(), "all"]
    run.add_argument("names", nargs="+", metavar="TASK", choices=names, help="or all: the scenes")
    _add(run, "full", "seeds", "methods", "fresh", "compare")
    again = commands.add_parser("draw", help="pictures and tables of committed results")
    again.add_argument("names", nargs="+", metavar="NAME", help="of a task or of a command")
    for name, study in _registry.studies().items():
        command = commands.add_parser(name, help=study.HELP)
        if "names" in study.OPTIONS:
            command.add_argument("names", nargs="*", metavar="TASK", help="these; all by default")
        _add(command, *(flag for flag in study.OPTIONS if flag != "names"))
    return said


def _add(command: argparse.ArgumentParser, *flags: str) -> None:
    for flag in flags:
        command.add_argument(f"--{flag}", **FLAGS[flag])


def main(arguments: list[str] | None = None, runs: Path = _study.RUNS) -> None:
    """Does what the command line says; what is run goes to benchmarks/runs."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = parser().parse_args(arguments)
    options.said = " ".join(["python -m benchmarks", *arguments])
    if options.command == "list":
        _list()
    elif options.command == "run":
        if "all" in options.names:
            _run.run_scenes(options, runs)
        for name in options.names:
            if name != "all":
                _run_task(name, options, runs / name)
    elif options.command == "draw":
        for name in options.names:
            _draw(name, runs / name)
    else:
        study = _registry.studies()[options.command]
        run = getattr(study, "run", None)
        if run is None:
            _study.run(study, options, runs / options.command)
        else:
            run(options, runs)


def _run_task(name: str, options: argparse.Namespace, folder: Path) -> None:
    try:
        _run.run_one(name, options, folder)
    except NotAble as reason:
        Console().print(f"{name} is not able here: {reason}.")


def _draw(name: str, folder: Path) -> None:
    """Draws and shows committed results again, from their numbers alone."""
    committed = _study.COMMITTED / name / "results.json"
    if not committed.exists():
        raise SystemExit(f"There are no committed results of {name!r}.")
    results = json.loads(committed.read_text())
    study = _registry.studies().get(name) or _run.shown_by(name)
    study.draw(results, folder)
    _study.show(study.tables(results))
    Console().print(f"Drawn into {folder}")


def _list() -> None:
    for title, entries in (("Tasks", _registry.tasks()), ("Methods", _registry.method_entries())):
        shown = Table(title=title, show_header=False, title_justify="left")
        for name, entry in entries.items():
            shown.add_row(name, entry.title)
        Console().print(shown)


if __name__ == "__main__":
    main()
