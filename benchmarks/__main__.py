"""The command line: `python -m benchmarks list | run TASK... | report | overhead | ...`."""

import argparse
import sys
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks import methods, tasks
from benchmarks._run import run_one, run_scenes
from benchmarks._task import NotAble

RESULTS = Path(__file__).parent / "results"


def parser() -> argparse.ArgumentParser:
    """What can be said on the command line."""
    said = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    commands = said.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="name the tasks and the methods")
    run = commands.add_parser("run", help="run methods on tasks; what has been run is kept")
    run.add_argument(
        "tasks", nargs="+", metavar="TASK", choices=[*tasks.TASKS, "all"], help="or all: the scenes"
    )
    run.add_argument("--full", action="store_true", help="every start, at full size")
    run.add_argument("--seeds", type=int, metavar="N", help="number of starts")
    run.add_argument("--methods", metavar="A,B", help="these, separated by commas")
    run.add_argument("--fresh", action="store_true", help="run again what has been run")
    commands.add_parser("overhead", help="derivatives against evaluating at the same points")
    commands.add_parser("filters", help="time of filters against moving their bytes")
    errors = commands.add_parser("variance", help="errors of derivatives, for what they cost")
    errors.add_argument("--full", action="store_true", help="every estimator and problem")
    errors.add_argument("--fresh", action="store_true", help="measure again, as the code changed")
    study = commands.add_parser("zerograds", help="the tables and figures of the ZeroGrads paper")
    study.add_argument("--full", action="store_true", help="ten starts, longer runs, more samples")
    study.add_argument("--seeds", type=int, metavar="N", help="number of starts of every study")
    study.add_argument("--fresh", action="store_true", help="run again what has been run")
    commands.add_parser("stress", help="stiff and extreme cases: expected, seen, verdict")
    page = commands.add_parser("report", help="report.html, from the results of the scenes")
    page.add_argument("tasks", nargs="*", metavar="TASK", help="these; all scenes by default")
    commands.add_parser("savings", help="what the savings of the scenes are worth in seconds")
    robustness = commands.add_parser("robustness", help="starts, samples, render noise, JPEG")
    robustness.add_argument("--full", action="store_true", help="more starts")
    robustness.add_argument("--fresh", action="store_true", help="run again what has been run")
    return said


def main(arguments: list[str] | None = None, results: Path = RESULTS) -> None:
    """Runs what the command line says; results go to benchmarks/results."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = parser().parse_args(arguments)
    command = " ".join(["python -m benchmarks", *arguments])

    if options.command == "list":
        _list()
    elif options.command == "run":
        if "all" in options.tasks:
            run_scenes(options, results, command)
        for task in options.tasks:
            if task != "all":
                _run(task, options, results / task, command)
    elif options.command == "variance":
        from benchmarks import variance

        setting = variance.FULL if options.full else variance.QUICK
        variance.main(results / "variance", setting, command=command, fresh=options.fresh)
    elif options.command == "report":
        from benchmarks import report

        report.main(results, options.tasks)
    elif options.command == "robustness":
        from benchmarks import robustness

        setting = robustness.FULL if options.full else robustness.QUICK
        folder = results / "robustness"
        robustness.main(folder, command, setting=setting, fresh=options.fresh)
    elif options.command == "savings":
        from benchmarks import savings

        savings.main(results / "savings")
    elif options.command == "zerograds":
        from benchmarks import zerograds

        size = zerograds.FULL if options.full else zerograds.QUICK
        if options.seeds:
            size = size.with_starts(options.seeds)
        zerograds.main(results / "zerograds", size, command=command, fresh=options.fresh)
    elif options.command == "stress":
        from benchmarks import stress

        stress.main(results / "stress")
    elif options.command == "filters":
        from benchmarks import filters

        filters.main(results / "filters")
    else:
        from benchmarks import overhead

        overhead.main(results / "overhead")


def _run(name: str, options: argparse.Namespace, folder: Path, command: str) -> None:
    try:
        run_one(name, options, folder, command)
    except NotAble as reason:
        Console().print(f"{name} is not able here: {reason}.")


def _list() -> None:
    for title, names, load in (
        ("Tasks", tasks.TASKS, tasks.module),
        ("Methods", methods.METHODS, methods.load),
    ):
        shown = Table(title=title, show_header=False, title_justify="left")
        for name in names:
            found = load(name)
            shown.add_row(name, getattr(found, "TITLE", None) or found.title)
        Console().print(shown)


if __name__ == "__main__":
    main()
