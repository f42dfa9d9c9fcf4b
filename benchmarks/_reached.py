"""Who got there: the table in which a run ends, and the lines for those that did not."""

import math
from collections.abc import Collection
from typing import Any, NamedTuple

from benchmarks._grid import Grid, Row, short, spread
from benchmarks._names import is_ours, name_of
from benchmarks._summary import REDUCTIONS, able

ERROR = "image_error"
SOLVED = "99"  # percent: what counts as solved
ENTERED = "90"  # percent: who gets as far is in the table


class Took(NamedTuple):
    """What a level took over the starts, infinite where it is not reached."""

    median: float
    lower: float
    upper: float
    solved: int
    starts: int

    @property
    def reached(self) -> bool:
        """By more than half of the starts."""
        return math.isfinite(self.median)


def took(found: dict[str, Any], cost: str, level: str = SOLVED, error: str = ERROR) -> Took:
    """What a method took to a level, by its part of the results."""
    level_of = found["took"][error][level]
    quartile = lambda name: math.inf if (q := level_of[cost][name]) is None else q
    median, lower, upper = quartile("median"), quartile("lower"), quartile("upper")
    return Took(median, lower, upper, level_of["solved"], found["starts"])


def ranked(task: dict[str, Any]) -> list[str]:
    """The methods that ran, the fastest to 99 % first, then those that leave least."""
    methods = able(task)

    def place(name: str) -> tuple[float, float, float]:
        found = methods[name]
        left = found["final"][ERROR]["median"]
        solved, entered = (took(found, "evaluations", each).median for each in (SOLVED, ENTERED))
        return solved, entered, math.inf if left is None else left

    return sorted(methods, key=place)


def entered(task: dict[str, Any]) -> tuple[list[str], list[str]]:
    """The methods that got to 90 % from more than half of the starts, and the others."""
    methods, names = able(task), ranked(task)
    there = {name: took(methods[name], "evaluations", ENTERED).reached for name in names}
    return [n for n in names if there[n]], [n for n in names if not there[n]]


def reached(
    task: dict[str, Any], brief: bool = False, alike: Collection[str] | None = None
) -> Grid:
    """Of those that got there, what they took to each level, and what they left.

    In brief it fits into 80 columns. `alike` are the methods whose seconds can be compared.
    """
    methods, budget = able(task), task["budget"]
    rows = []
    for name in entered(task)[0]:
        found = methods[name]
        levels, parameters = found["took"][ERROR], found["took"]["parameter_error"][SOLVED]
        shown = {"solved": f"{levels[SOLVED]['solved']}/{found['starts']}"}
        for level in REDUCTIONS:
            took_so_many = levels[level]["evaluations"]
            median = short(took_so_many["median"])
            shown[f"{level} %"] = spread(took_so_many) if level == SOLVED else median
        seconds = levels[SOLVED]["seconds"]
        said = short(seconds["median"]) if brief else spread(seconds)
        shown["seconds"] = said if alike is None or name in alike else f"({said})"
        if not brief:
            shown["parameters"] = short(parameters["evaluations"]["median"])
        shown["left, %"] = short(_percent(found["final"][ERROR]["median"]))
        rows.append((name, shown))
    limit = f"At most {budget['evaluations']:,} evaluations or {budget['seconds']:g} s a run."
    parameters = "" if brief else " Parameters: evaluations to 99 % of their error."
    elsewhere = "" if alike is None or {*alike} >= {*methods} else " (in brackets: elsewhere)"
    return Grid(
        title=f"{task['title']}: evaluations to 90, 99 and 99.9 % of the image error",
        caption=f"Medians [quartiles] over the starts; - is no more than half of them. Seconds are "
        f"to 99 %{elsewhere}.{parameters} {limit}",
        columns=("method", *(rows[0][1] if rows else ())),
        rows=tuple(
            Row(name_of(name, methods[name]["title"]), tuple(shown.values()), name, is_ours(name))
            for name, shown in rows
        ),
    )


def others(task: dict[str, Any]) -> str:
    """One line for those that did not get there; empty where all did."""
    methods = able(task)
    left = [
        f"{name_of(name, methods[name]['title'])} "
        f"({short(_percent(methods[name]['final'][ERROR]['median']))} %)"
        for name in entered(task)[1]
    ]
    if not left:
        return ""
    return (
        f"Not to 90 % from more than half of the starts, with what they leave: {', '.join(left)}."
    )


def not_able(task: dict[str, Any]) -> str:
    """One line for those that could not run; empty where all could."""
    reasons = {
        name_of(name, found["title"]): found["not_able"]
        for name, found in task["methods"].items()
        if "not_able" in found
    }
    return " ".join(f"{who} is not able here: {why}." for who, why in reasons.items())


def ran_on(task: dict[str, Any]) -> dict[str, list[str]]:
    """The machines, as far as they are recorded, with the methods that ran on each."""
    found: dict[str, list[str]] = {}
    for name, each in able(task).items():
        for machine in each.get("machines", ()):
            found.setdefault(machine, []).append(name)
    return found


def alike(task: dict[str, Any], name: str) -> list[str]:
    """The methods whose seconds can be put beside those of one: they ran where it ran."""
    methods = able(task)
    return [
        each for each in methods if methods[each].get("machines") == methods[name].get("machines")
    ]


def machines(task: dict[str, Any]) -> str:
    """One line for what ran where; empty where all ran on one machine."""
    found = ran_on(task)
    if len(found) < 2:
        return ""
    each = (f"{', '.join(map(name_of, names))} on {where}" for where, names in found.items())
    return f"Seconds can be compared on one machine only. Run: {'; '.join(each)}."


def _percent(share: float | None) -> float | None:
    return None if share is None else 100 * share
