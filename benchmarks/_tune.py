"""The best settings of a method on a task, of a grid, on starts that are not scored.

One setting after the other is moved along its axis of the grid with the others where they are, and
all of them in turn until none moves. Where the best value is at an end of its axis, the axis goes
on in the same ratio, so that the best one is inside; a whole number ends at 1.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from benchmarks._levels import Race, Settings
from benchmarks._task import Method

SEEDS = range(10_000, 10_005)  # in no ensemble
PENALTY = 2.0  # budgets that a run counts as that never got to the level
TURNS = 3  # of all settings, at most
FURTHER = 6  # values that an axis goes on, at most, on each side
Grid = Mapping[str, Sequence[float]]


class Tuned(NamedTuple):
    """What was found: the settings, those of them that are at the end of their axis, and all tried.

    `tried` has a mean cost for each, in evaluations.
    """

    settings: dict[str, float]
    at_the_edge: list[str]
    tried: list[dict[str, Any]]


def tune(
    race: Race,
    method: Method,
    grid: Grid,
    seeds: Sequence[int] = SEEDS,
    turns: int = TURNS,
    fixed: Settings | None = None,
) -> Tuned:
    """By the geometric mean of the evaluations to the last level; `fixed` stays as it is.

    Raises:
        NotAble: The method cannot run on the task.
    """

    def cost(settings: dict[str, float]) -> float:
        took = race(method, seeds, {**(fixed or {}), **settings})[:, -1]
        return float(np.exp(np.mean(np.log(np.minimum(took, PENALTY * race.budget)))))

    found = search(cost, grid, turns)
    return found._replace(settings={**(fixed or {}), **found.settings})


def search(cost: Callable[[dict[str, float]], float], grid: Grid, turns: int = TURNS) -> Tuned:
    """The lowest cost, setting by setting; ties go to the value that was there before."""
    axes = {name: list(values) for name, values in grid.items()}
    at = {name: values[len(values) // 2] for name, values in axes.items()}
    known: dict[tuple, float] = {}

    def known_cost(settings: dict[str, float]) -> float:
        point = tuple(settings.values())
        if point not in known:
            known[point] = cost(settings)
        return known[point]

    for _ in range(turns):
        before = dict(at)
        for name, axis in axes.items():
            of = lambda value, name=name: known_cost(at | {name: value})
            at[name] = _along(axis, of, at[name])
        if at == before:
            break
    edges = [name for name, axis in axes.items() if _ends(axis, at[name])]
    names = list(axes)
    tried = [dict(zip(names, point, strict=True)) | {"cost": c} for point, c in known.items()]
    return Tuned(at, edges, tried)


def _along(axis: list[float], cost: Callable[[float], float], now: float) -> float:
    """The best of an axis, which grows where that is at one of its ends."""
    best = lambda: min(axis, key=lambda value: (cost(value), value != now))
    for _ in range(FURTHER):
        low, high = _beyond(axis)
        found = best()
        if found == axis[0] and low is not None:
            axis.insert(0, low)
        elif found == axis[-1] and high is not None:
            axis.append(high)
        else:
            break
    return best()


def _ends(axis: list[float], value: float) -> bool:
    """Whether a value is at an end of its axis beyond which there is more."""
    low, high = _beyond(axis)
    return (value == axis[0] and low is not None) or (value == axis[-1] and high is not None)


def _beyond(axis: list[float]) -> tuple[float | None, float | None]:
    """The values after the ends, if there are any."""
    if len(axis) < 2:
        return None, None
    low, high = axis[0] ** 2 / axis[1], axis[-1] ** 2 / axis[-2]
    if all(isinstance(value, int) for value in axis):
        low, high = math.floor(low), math.ceil(high)
        return (low if 1 <= low < axis[0] else None), high
    return low, high
