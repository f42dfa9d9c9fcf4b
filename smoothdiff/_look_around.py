"""What a few evaluations around a point show of a function: noise, plateaus, jumps, scales."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

# widths, in sigma, at which to look where nothing changes nearer
_WIDER = 4.0, 16.0, 64.0
WIDEST = _WIDER[-1]
# an interval is halved so often, and judged by the change that is left after the last few times: a
# smooth function has an eighth of it, many small jumps of residuals a third, and one jump all
_HALVED, _LAST, _SMOOTH = 6, 3, 0.22
# what rounding may do to a value, in units of its own
_ROUNDING = 64

Rows = Callable[[Float[np.ndarray, "m n"]], Float[np.ndarray, "m P"]]


@dataclass(frozen=True)
class View:
    """What was seen: `changes` by one sigma along each direction, to either side, as lengths.

    A change is NaN where the function is not, and zero where a bound left no room. `width` is where
    the first change was seen, in sigma, and 0 if there was none. `jumps` is None if it is not
    known. Lengths are those of the vector of residuals, and `noise` is that of the difference of
    two values at one point, in the root of its mean square.
    """

    finite: bool
    noise: float
    changes: Float[np.ndarray, "2 k"]
    width: float
    jumps: bool | None
    evaluations: int

    @property
    def effects(self) -> Float[np.ndarray, " k"]:
        """The larger change of both sides; zero where neither is finite."""
        return np.max(np.nan_to_num(self.changes), axis=0)

    @property
    def failed(self) -> Bool[np.ndarray, " k"]:
        """Where a side is not finite."""
        return np.any(np.isnan(self.changes), axis=0)


def look_around(
    rows: Rows,
    here: Float[np.ndarray, " n"],
    sigma: Float[np.ndarray, " n"],
    clip: Callable[[np.ndarray], np.ndarray],
    directions: Float[np.ndarray, "k n"],
    further: Float[np.ndarray, " n"],
) -> View:
    """Evaluates `rows` twice at a point, on both sides along each direction, and in between.

    Where nothing changes it goes on along the direction `further`, to both sides.
    """
    twice = rows(np.stack([here, here]))
    eps = float(np.finfo(twice.dtype).eps)
    # the squares of float32 may be zero or infinite
    base, again = twice.astype(float)
    seen: Rows = lambda points: rows(points).astype(float)
    if not (np.all(np.isfinite(base)) and np.all(np.isfinite(again))):
        return View(False, 0.0, np.zeros((2, len(directions))), 0.0, None, 2)
    least = _ROUNDING * eps * float(np.linalg.norm(base))
    count, noise = 2, float(np.linalg.norm(again - base))
    if noise <= least:
        noise = 0.0
    else:
        # two values alone say little of how large it is
        more = seen(np.stack([here, here]))
        deviations = np.std(np.stack([base, again, *more]), axis=0, ddof=1)
        count, noise = 4, float(np.sqrt(2) * np.linalg.norm(deviations))

    def look(steps: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        points = clip(here + steps * sigma)
        out = seen(points)
        lengths = np.linalg.norm(out - base, axis=1)
        return points, out, np.where(np.isfinite(lengths), lengths, np.nan)

    points, out, found = look(np.concatenate([directions, -directions]))
    count, width, jumps = count + len(points), 1.0, None
    changes = found.reshape(2, -1)
    wider = iter(_WIDER)
    while width and not np.any(found > 0):
        width = next(wider, 0.0)
        if width:
            points, out, found = look(width * np.stack([further, -further]))
            count += 2
    if width and not noise:
        end = np.nanargmax(found)
        jumps, more = _jumps(seen, (here, base), (points[end], out[end]), least)
        count += more
    return View(True, noise, changes, width, jumps, count)


def _jumps(
    rows: Rows, low: tuple[np.ndarray, ...], high: tuple[np.ndarray, ...], least: float
) -> tuple[bool | None, int]:
    """Whether the change between two points is no smaller within ever shorter intervals.

    And how many evaluations that took.
    """
    lengths = []
    for done in range(_HALVED):
        middle = (low[0] + high[0]) / 2
        row = rows(middle[None])[0]
        left, right = np.linalg.norm(row - low[1]), np.linalg.norm(high[1] - row)
        if not np.isfinite(left + right):
            return None, done + 1
        low, high = (low, (middle, row)) if left > right else ((middle, row), high)
        lengths.append(max(left, right))
    before, after = lengths[-1 - _LAST], lengths[-1]
    return bool(after > _SMOOTH * before) if _SMOOTH * before > least else None, _HALVED
