"""The command line: `python -m benchmarks [list] | run TASK... | draw NAME... | report | ...`."""

import argparse
import sys
from functools import partial
from pathlib import Path
from types import ModuleType

import jax
from rich.console import Console
from tqdm import tqdm

from benchmarks import _black_boxes, _descents, _keep, _listing, _registry, _study
from benchmarks._task import NotAble
from benchmarks.studies import report

STARTS = {False: 5, True: 20}  # of most scenes, quick and full: a guess, for the bar only
FLAGS: dict[str, dict] = {
    "full": {"action": "store_true", "help": "every start, at full size"},
    "seeds": {"type": int, "metavar": "N", "help": "number of starts"},
    "fresh": {"action": "store_true", "help": "run again what has been run"},
    "methods": {"metavar": "A,B", "help": "these, separated by commas"},
    "jobs": {"type": int, "metavar": "N", "default": 1, "help": "processes side by side"},
    "tuned": {"action": "store_true", "help": "also at the best of a grid, on other starts"},
    "compare": {"action": "store_true", "help": "show the committed results too"},
    "runs": {"action": "store_true", "help": "of what was run here, not of what is committed"},
}


def parser() -> argparse.ArgumentParser:
    """What can be said on the command line."""
    said = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    commands = said.add_subparsers(dest="command")
    commands.add_parser("list", help="name the tasks and the methods; the same as nothing")
    run = commands.add_parser("run", help="run methods on tasks; what has been run is kept")
    names = [*_registry.tasks(), "all"]
    run.add_argument("names", nargs="+", metavar="TASK", choices=names, help="or all: the scenes")
    _add(run, "full", "seeds", "methods", "tuned", "fresh", "compare")
    again = commands.add_parser("draw", help="pictures and tables of committed results")
    again.add_argument("names", nargs="+", metavar="NAME", help="of a task or of a command")
    stay = commands.add_parser("keep", help="what was run takes its place in what is committed")
    stay.add_argument("names", nargs="+", metavar="TASK", choices=[*_registry.tasks()])
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
    if options.command in (None, "list"):
        _listing.show()
    elif options.command == "run":
        if "all" in options.names:
            _run_scenes(options, runs)
        for name in (name for name in options.names if name != "all"):
            try:
                _run(name, options, runs / name)
            except NotAble as reason:
                Console().print(f"{name} is not able here: {reason}.", markup=False)
        _page(options.names, runs)
    elif options.command == "draw":
        for name in options.names:
            _draw(name, runs / name)
    elif options.command == "keep":
        for name in options.names:
            _keep.keep(name, runs, _study.COMMITTED)
            Console().print(f"{name}: kept in {_study.COMMITTED / name}", soft_wrap=True)
    else:
        study = _registry.studies()[options.command]
        run = getattr(study, "run", partial(_study.run, study))
        run(options, runs / options.command)


def _study_of(name: str) -> ModuleType:
    """What measures, draws and shows a task, by its kind."""
    return _descents if _registry.task(name).kind == "descent" else _black_boxes


def _run(name: str, options: argparse.Namespace, folder: Path, bar: tqdm | None = None) -> None:
    """Runs a task, with the bar of several scenes or one of its own."""
    study = _study_of(name)
    _study.run(study, options, folder, partial(study.measure, name, bar=bar))


def _run_scenes(options: argparse.Namespace, runs: Path) -> None:
    """All scenes, one after the other, with one bar; a scene that fails is named at the end."""
    starts = options.seeds or STARTS[options.full]
    usual = partial(_black_boxes.usual, options=options)
    planned = {name: len(usual(name)) * starts for name in _registry.scenes()}
    missing = []
    with tqdm(total=sum(planned.values()), unit="run") as bar:
        while planned:
            name = next(iter(planned))
            try:
                with _black_boxes.forgiving():
                    _run(name, options, runs / name, bar)
            except NotAble as reason:
                missing.append(f"{name} is not able here: {reason}.")
            del planned[name]
            bar.total = bar.n + sum(planned.values())
            jax.clear_caches()  # what was compiled for it would stay in memory
    for line in missing:
        Console().print(line, markup=False)


def _page(names: list[str], runs: Path) -> None:
    """Makes the page of these runs, if there is something to show, and says where it is."""
    shown = [] if "all" in names else [n for n in names if _registry.task(n).kind != "descent"]
    if "all" in names or shown:
        written = report.write(runs, runs, shown)
        if written is not None:
            Console().print(f"The page: {written}", markup=False, soft_wrap=True)


def _draw(name: str, folder: Path) -> None:
    """Draws and shows committed results again, from their numbers alone."""
    results = _study.committed(name)
    if results is None:
        raise SystemExit(f"There are no committed results of {name!r}.")
    study = _registry.studies().get(name) or _study_of(name)
    study.draw(results, folder)
    _study.show(study.tables(results))
    Console().print(f"Drawn into {folder}")


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit("Interrupted; what was run is kept.")
