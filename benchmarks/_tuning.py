"""The best of a grid of settings, found by walking along its axes until no neighbour is better.

So all methods that are tuned have the same grid, and none is left at an edge that further values
would have moved: rates have no last one. What is best is so among its neighbours along each axis;
the whole grid is not tried.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

SEED = 1000  # the first of the starts that are tuned on; none of them is scored
RATIO = 2.0  # of one rate to the one before
Settings: TypeAlias = dict[str, Any]


class Rates(NamedTuple):
    """An axis without ends: `first` times all powers of the ratio."""

    first: float
    ratio: float = RATIO

    def at(self, step: int) -> float:
        """The rate so many steps from the first, in four digits."""
        return float(f"{self.first * self.ratio**step:.4g}")


Axis: TypeAlias = Rates | Sequence[Any]


class Best(NamedTuple):
    """What a walk found.

    Args:
        settings: The best, by name.
        cost: What they cost.
        ends: The axes at whose last value they are.
        tried: How many settings were tried for it; those of an earlier walk count too.
    """

    settings: Settings
    cost: float
    ends: tuple[str, ...]
    tried: int


def seeds(number: int) -> range:
    """So many starts to tune on."""
    return range(SEED, SEED + number)


def walk(cost: Callable[[Settings], float], axes: Mapping[str, Axis], start: Settings) -> Best:
    """The settings from which no step along an axis lowers the cost, which may be NaN.

    Args:
        cost: What is made least. It is asked once for each of the settings.
        axes: The values of each setting in their order.
        start: Where the walk begins, values of the axes.
    """
    names, known = list(axes), dict[tuple[int, ...], float]()

    def settings(at: tuple[int, ...]) -> Settings:
        return {name: _value(axes[name], step) for name, step in zip(names, at, strict=True)}

    def ask(at: tuple[int, ...]) -> float:
        if at not in known:
            found = float(cost(settings(at)))
            known[at] = math.inf if math.isnan(found) else found
        return known[at]

    at = tuple(_step(axes[name], start[name]) for name in names)
    before = None
    while at != before:
        before = at
        for i, name in enumerate(names):
            for way in (1, -1):
                there = (*at[:i], at[i] + way, *at[i + 1 :])
                while _is_on(axes[name], there[i]) and ask(there) < ask(at):
                    at, there = there, (*there[:i], there[i] + way, *there[i + 1 :])
    ends = (name for name, step in zip(names, at, strict=True) if _at_end(axes[name], step))
    return Best(settings(at), ask(at), tuple(ends), len(known))


def geometric_mean(errors: Sequence[float], floor: float = 0.0) -> float:
    """The mean in the logarithm, of errors that count as at least the floor."""
    with np.errstate(divide="ignore"):
        return float(np.exp(np.mean(np.log(np.maximum(errors, floor)))))


def _value(axis: Axis, step: int) -> Any:
    return axis.at(step) if isinstance(axis, Rates) else axis[step]


def _step(axis: Axis, value: Any) -> int:
    if isinstance(axis, Rates):
        return round(math.log(value / axis.first, axis.ratio))
    return list(axis).index(value)


def _is_on(axis: Axis, step: int) -> bool:
    return isinstance(axis, Rates) or 0 <= step < len(axis)


def _at_end(axis: Axis, step: int) -> bool:
    return not isinstance(axis, Rates) and step in (0, len(axis) - 1)
