"""The command line: `python -m benchmarks list | run TASK... | overhead | filters | ...`."""

import argparse
import json
import sys
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks import methods, tasks
from benchmarks._task import NotAble, Task

RESULTS = Path(__file__).parent / "results"


def main(arguments: list[str] | None = None, results: Path = RESULTS) -> None:
    """Runs what the command line says; results go to benchmarks/results."""
    arguments = sys.argv[1:] if arguments is None else arguments
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="name the tasks and the methods")
    run = commands.add_parser("run", help="run methods on tasks; what has been run is kept")
    run.add_argument("tasks", nargs="+", metavar="TASK", choices=tasks.TASKS)
    run.add_argument("--full", action="store_true", help="every start, at full size")
    run.add_argument("--seeds", type=int, metavar="N", help="number of starts")
    run.add_argument("--methods", metavar="A,B", help="these, separated by commas")
    run.add_argument("--fresh", action="store_true", help="run again what has been run")
    commands.add_parser("overhead", help="derivatives against evaluating at the same points")
    commands.add_parser("filters", help="time of filters against moving their bytes")
    errors = commands.add_parser("variance", help="errors of derivatives, for what they cost")
    errors.add_argument("--full", action="store_true", help="every estimator and problem")
    errors.add_argument("--fresh", action="store_true", help="measure again, as the code changed")
    commands.add_parser("stress", help="stiff and extreme cases: expected, seen, verdict")
    options = parser.parse_args(arguments)
    command = " ".join(["python -m benchmarks", *arguments])

    if options.command == "list":
        _list()
    elif options.command == "run":
        for task in options.tasks:
            _run(task, options, results / task, command)
    elif options.command == "variance":
        from benchmarks import variance

        setting = variance.FULL if options.full else variance.QUICK
        variance.main(results / "variance", setting, command=command, fresh=options.fresh)
    elif options.command == "stress":
        from benchmarks import stress

        stress.main(results / "stress")
    elif options.command == "filters":
        from benchmarks import filters

        filters.main(results / "filters")
    else:
        from benchmarks import overhead

        overhead.main(results / "overhead")


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


def _run(name: str, options: argparse.Namespace, folder: Path, command: str) -> None:
    from benchmarks import _family, _report, descents

    module = tasks.module(name)
    try:
        built = module.build(options.full)
    except NotAble as reason:
        Console().print(f"{name} is not able here: {reason}.")
        return
    first = built[0] if isinstance(built, list) else built
    if isinstance(first, descents.Descent):
        descents.run(built, options, folder, command)
        return
    console = Console()
    if isinstance(built, list):
        members = [_run_task(task, options, folder / task.name, command) for task in built]
        results = _family.summarise(module.TITLE, members)
        _family.draw(results, folder / "evaluations.png")
        shown = _family.tables(results)
    else:
        results = _run_task(built, options, folder, command)
        shown = _report.tables(results)
    (folder / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    console.print(shown)
    console.print(f"Written to {folder}")


def _run_task(task: Task, options: argparse.Namespace, folder: Path, command: str) -> dict:
    from benchmarks import _report, _summary
    from benchmarks._harness import run

    setting = "full" if options.full else "quick"
    usual = methods.METHODS if options.full else methods.QUICK
    chosen = options.methods.split(",") if options.methods else usual
    found = run(
        task,
        [methods.load(method) for method in chosen],
        options.seeds or task.seeds,
        folder / "runs",
        setting=setting,
        fresh=options.fresh,
    )
    folder.mkdir(parents=True, exist_ok=True)
    results = _summary.summarise(task, found, setting, command)
    _report.write(task, results, folder)
    return results


if __name__ == "__main__":
    main()
