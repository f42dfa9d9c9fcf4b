"""From the runs of a descent to numbers and to tables on the terminal."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from rich import box
from rich.console import Group
from rich.table import Table

from benchmarks._report import show
from benchmarks._summary import cost_to_level, machine, quartiles
from benchmarks.descents._descent import Descent
from benchmarks.descents._loop import Run
from benchmarks.descents._runs import Choice


def summarise(
    descent: Descent, found: dict[str, tuple[Choice, list[Run]]], setting: str, command: str
) -> dict[str, Any]:
    """What is written to results.json."""
    return {
        "descent": descent.name,
        "title": descent.title,
        "score": descent.score,
        "setting": setting,
        "notes": descent.notes,
        "marks": list(descent.marks),
        "tuning_seeds": descent.tuning_seeds,
        "command": command,
        "machine": machine(),
        "configurations": {
            each.name: {"title": each.title}
            | _choice(descent, found[each.name][0])
            | _of_runs(descent, found[each.name][1])
            for each in descent.configurations
        },
    }


def _choice(descent: Descent, choice: Choice) -> dict[str, Any]:
    return {
        "variant": choice.variant,
        "rate": choice.rate,
        "at_edge": choice.rate in (descent.rates[0], descent.rates[-1]),
        "tried": {
            variant: {f"{rate:g}": error if np.isfinite(error) else None for rate, error in row}
            for variant, row in ((name, tried.items()) for name, tried in choice.tried.items())
        },
    }


def _of_runs(descent: Descent, runs: Sequence[Run]) -> dict[str, Any]:
    iterations = runs[0].iterations.tolist()
    errors = {
        name: [[_finite(e) for e in run.errors[name].tolist()] for run in runs]
        for name in sorted(runs[0].errors, key=lambda name: name != descent.score)
    }
    scores = [run.errors[descent.score].tolist() for run in runs]
    return {
        "runs": len(runs),
        "iterations": iterations,
        "seconds": [run.seconds.tolist() for run in runs],
        "errors": errors,
        "at_marks": {
            name: {
                str(mark): quartiles(
                    [float(run.errors[name][iterations.index(mark)]) for run in runs]
                )
                for mark in descent.marks
            }
            for name in errors
        },
        "to_levels": {
            f"{level:g}": quartiles([cost_to_level(each, iterations, level) for each in scores])
            for level in descent.levels
        },
        "ms_an_iteration": quartiles([1e3 * run.seconds[-1] / iterations[-1] for run in runs]),
    }


def _finite(error: float) -> float | None:
    return error if np.isfinite(error) else None  # JSON knows no other


def tables(results: dict[str, Any]) -> Group:
    """Errors at the marks, a table for each error, and what the levels took."""
    errors = next(iter(results["configurations"].values()))["at_marks"]
    return Group(*(_at_marks(results, error) for error in errors), _to_levels(results))


def _at_marks(results: dict[str, Any], error: str) -> Table:
    shown = Table(
        title=f"{results['title']} ({results['setting']}): {error}",
        caption="Median \\[quartiles] over the starts, after so many iterations.",
        box=box.SIMPLE_HEAD,
    )
    shown.add_column("configuration", no_wrap=True)
    for mark in results["marks"]:
        shown.add_column(str(mark), justify="right")
    for found in results["configurations"].values():
        marks = found["at_marks"][error].values()
        shown.add_row(found["title"], *(_cell(each) for each in marks))
    return shown


def _to_levels(results: dict[str, Any]) -> Table:
    configurations = list(results["configurations"].values())
    levels = configurations[0]["to_levels"]
    shown = Table(
        title=f"Iterations until the {results['score']} is at most",
        caption="The rate was tuned on other starts; * is the end of the grid. - is not reached.\n"
        "Extra time is that of an iteration over the first line's.",
        box=box.SIMPLE_HEAD,
    )
    shown.add_column("configuration", no_wrap=True)
    for column in (*levels, "rate", "variant", "ms/iteration", "extra time"):
        shown.add_column(column, justify="right")
    usual = configurations[0]["ms_an_iteration"]["median"]
    for found in configurations:
        extra = found["ms_an_iteration"]["median"] / usual - 1
        shown.add_row(
            found["title"],
            *(_cell(found["to_levels"][level]) for level in levels),
            f"{found['rate']:g}{'*' if found['at_edge'] else ''}",
            found["variant"],
            _cell(found["ms_an_iteration"]),
            f"{100 * extra:.0f} %",
        )
    return shown


def _cell(quartiles: dict[str, float | None]) -> str:
    """Without a space in the quartiles: a line breaks before them, not in them."""
    return show(quartiles).replace(", ", "–")
