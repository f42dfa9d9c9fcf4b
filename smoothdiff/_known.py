"""What a function of whole numbers returned: without noise no point has to be evaluated again."""

from collections import Counter
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from smoothdiff._devices import put_with
from smoothdiff._layout import Layout, layout_of
from smoothdiff._solvers._judgement import ROUNDING
from smoothdiff._unit_space import UnitSpace

# the rows at points, in units
Evaluate = Callable[[Float[Array | np.ndarray, "k n"]], Float[Array, "k P"]]

# a function has no noise if it had the same value again at so many points, or so often, and never
# another
_ENOUGH, _OFTEN = 2, 3
# after so many answers in a row a search finds nothing that is new
_IDLE = 300
# bytes of rows that are kept
_MOST = 2**27


class Known:
    """Rows of a function by the point of a grid.

    Points that come again are evaluated again until two of them had the same row, or one of them
    three times more. From then on they are answered from here; `answered` counts them. A row that
    is another one says that the function has noise, and no point is answered any more. What failed
    once is tried again, once.
    """

    def __init__(self, units: UnitSpace, layout: Layout, count: int):
        """For a grid of so many points, whose unit coordinates are vectors of this layout."""
        self._units, self._layout, self._count = units, layout, count
        self._rows: dict[bytes, np.ndarray] = {}
        self._same: Counter[bytes] = Counter()
        self._failed: set[bytes] = set()
        self._noisy, self._bytes, self._idle = False, 0, 0
        self.answered = 0

    @staticmethod
    def of(units: UnitSpace, y: PyTree[Array], solver: Any) -> "Known | None":
        """For parameters like `y`, if all are whole numbers, and no devices share out the rows."""
        count = units.count()
        if count is None or getattr(solver, "sharding", None) is not None:
            return None
        return Known(units, layout_of(y), count)

    @property
    def complete(self) -> bool:
        """Whether the function is known at all points of the grid."""
        return self._sure and len(self._rows) == self._count

    @property
    def exhausted(self) -> bool:
        """Whether nothing is left to find, or a search finds nothing any more."""
        return self.complete or self._idle >= _IDLE

    @property
    def _sure(self) -> bool:
        enough = len(self._same) >= _ENOUGH or self._same.total() >= _OFTEN
        return enough and not self._noisy

    def rows(
        self, points: Float[Array | np.ndarray, "K n"], evaluate: Evaluate
    ) -> Float[Array, "K P"]:
        """What the function returns at these points, of which it is evaluated at the others."""
        if not self._sure:
            return self.fresh(points, evaluate)
        names = self._names(points)
        known = lambda i: names[i] in self._rows or names[i] in names[:i]
        new = [i for i in range(len(names)) if not known(i)]
        answered = len(names) - len(new)
        self.answered += answered
        self._idle = 0 if new else self._idle + answered
        found = {}
        if new:
            rows = self.fresh(points[np.asarray(new)], evaluate)
            found = {names[i]: row for i, row in zip(new, np.asarray(rows), strict=True)}
        rows = np.stack([found[n] if n in found else self._rows[n] for n in names])
        return jnp.asarray(put_with(points, rows))

    def fresh(
        self, points: Float[Array | np.ndarray, "K n"], evaluate: Evaluate
    ) -> Float[Array, "K P"]:
        """What the function returns at these points, evaluated at each."""
        rows = evaluate(points)
        self.learn(points, rows)
        return rows

    def learn(self, points: Float[Array | np.ndarray, "K n"], rows: Float[Array, "K P"]) -> None:
        """Keeps rows that the function returned."""
        if self._noisy:
            return
        for name, row in zip(self._names(points), np.asarray(rows), strict=True):
            if not np.all(np.isfinite(row)) and name not in self._failed:
                self._failed.add(name)
                continue
            before = self._rows.get(name)
            if before is not None and np.all(np.isfinite(before)):
                self._compare(name, before, row)
            elif self._bytes < _MOST:
                self._rows[name] = row
                self._bytes += row.nbytes

    def _compare(self, name: bytes, before: np.ndarray, row: np.ndarray) -> None:
        near = ROUNDING * np.finfo(row.dtype).eps * np.max(np.abs(before))
        if np.all(np.abs(row - before) <= near):
            self._same[name] += 1
        else:
            self._noisy = True
            self._rows.clear()

    def _names(self, points: Float[Array | np.ndarray, "K n"]) -> list[bytes]:
        leaves = jax.tree.leaves(self._units.natural(self._layout.tree(points)))
        columns = [np.asarray(leaf) for leaf in leaves]
        return [b"".join(column[i].tobytes() for column in columns) for i in range(len(points))]
