"""Lines in a plane with logarithmic axes, as numbers and texts that the template draws as SVG."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from benchmarks._names import NAMES
from benchmarks._pictures import FLOORS, LABELS
from benchmarks._summary import grid
from benchmarks.studies.profiles.shares import POINTS
from benchmarks.studies.report._scene import Scene

WIDTH, HEIGHT = 360, 250  # of the whole, in units of the SVG
LEFT, RIGHT, TOP, BOTTOM = 52, 352, 14, 214  # of what is within the axes
MOST_TICKS = 6


class Line(NamedTuple):
    """A line; one without a colour is one of the rest."""

    points: str
    colour: str | None = None
    dash: str = ""
    name: str = ""
    band: str = ""


class Tick(NamedTuple):
    at: float
    label: str


class Chart(NamedTuple):
    """All that is drawn; the rest first, so that what is named lies above."""

    label: str
    across: str
    lines: list[Line]
    x: list[Tick]
    y: list[Tick]
    width: int = WIDTH
    height: int = HEIGHT


class _Axis(NamedTuple):
    """From numbers to places, logarithmic."""

    low: float
    high: float
    begin: float
    end: float

    def at(self, values: ArrayLike) -> np.ndarray:
        """The places of numbers; what is beyond an end is there."""
        span = math.log(self.high / self.low)
        share = np.log(np.clip(values, self.low, self.high) / self.low) / span
        return self.begin + share * (self.end - self.begin)

    def ticks(self, percent: bool = False) -> list[Tick]:
        """Powers of ten."""
        first = math.ceil(math.log10(self.low) - 1e-9)
        last = math.floor(math.log10(self.high) + 1e-9)
        powers = range(first, last + 1, max(1, -(-(last - first + 1) // MOST_TICKS)))
        return [Tick(round(float(self.at(10.0**p)), 1), _power(p, percent)) for p in powers]


def of_scene(scene: Scene, named: Sequence[str], error: str, cost: str) -> Chart | None:
    """Medians of an error against a cost; those that are named in colour, ours with quartiles.

    None where all gave up at once.
    """
    curves = {}
    for name in scene.comparable(cost):
        curve = scene.ran[name]["curves"][error][cost]
        if curve["ends"] is not None:
            three = np.nan_to_num(np.array(curve["quartiles"], float), nan=np.inf)
            curves[name] = grid(curve["ends"]), np.maximum(three, FLOORS[error])
    if not curves:
        return None
    all_costs = [ends for costs, _ in curves.values() for ends in (costs[0], costs[-1])]
    shown = np.concatenate([three[1] for _, three in curves.values()] + [[0.1, 1.0]])
    x = _Axis(min(all_costs), 1.001 * max(all_costs), LEFT, RIGHT)
    highest = min(10, max(shown[np.isfinite(shown)]))
    y = _Axis(min(shown) / 1.3, 1.3 * highest, BOTTOM, TOP)
    others = (curves[name] for name in curves if name not in named)
    rest = [Line(_points(x, y, costs, three[1])) for costs, three in others]
    above = []
    for name in (name for name in reversed(named) if name in curves):
        costs, three = curves[name]
        look = NAMES[name]
        band = ""
        if name == scene.ours:
            upper = _points(x, y, costs[::-1], three[2][::-1])
            band = f"{_points(x, y, costs, three[0])} {upper}"
        above.append(Line(_points(x, y, costs, three[1]), look.colour, look.dash, look.name, band))
    return Chart(LABELS[error], LABELS[cost], rest + above, x.ticks(), y.ticks(percent=True))


def of_profile(panel: dict[str, Any], level: str) -> Chart:
    """Shares of problems that are solved, against the budget."""
    budgets = np.geomspace(1, panel["budgets"][-1], POINTS)
    x = _Axis(1, budgets[-1], LEFT, RIGHT)
    up = lambda share: BOTTOM + np.asarray(share) * (TOP - BOTTOM)
    lines = []
    for name, found in panel["levels"][level].items():
        pairs = zip(x.at(budgets), up(found["curve"]), strict=True)
        points = " ".join(f"{a:.0f},{b:.1f}" for a, b in pairs)
        lines.append(Line(points, NAMES[name].colour, NAMES[name].dash, NAMES[name].name))
    unit = f"(n + {panel['more']})" if panel["more"] else "n"
    y = [Tick(float(up(share)), f"{100 * share:.0f} %") for share in (0, 0.25, 0.5, 0.75, 1)]
    label = f"{panel['title']}: share solved to {level}"
    return Chart(label, f"Evaluations / {unit}", lines, x.ticks(), y)


def _points(x: _Axis, y: _Axis, across: np.ndarray, up: np.ndarray) -> str:
    places = zip(x.at(across), y.at(up), strict=True)
    return " ".join(f"{a:.0f},{b:.1f}" for a, b in places)


def _power(exponent: int, percent: bool) -> str:
    exponent += 2 * percent
    value = f"{10.0**exponent:,.{max(0, -exponent)}f}" if -3 <= exponent <= 5 else f"1e{exponent}"
    return value + " %" * percent
