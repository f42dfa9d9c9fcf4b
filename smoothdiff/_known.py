"""What a function of whole numbers returned: without noise no point has to be evaluated again."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from smoothdiff._layout import Layout
from smoothdiff._solvers._judgement import ROUNDING
from smoothdiff._unit_space import UnitSpace

# a function has no noise if so many points had the same value again, and none another
_ENOUGH = 2


class Known:
    """Rows of a function by the point of a grid.

    Points that come again are evaluated again until two of them had the same row. From then on they
    are answered from here; `answered` counts them. A row that is another one says that the function
    has noise, and no point is answered any more.
    """

    def __init__(self, units: UnitSpace, count: int):
        """For a grid of so many points."""
        self._units, self._count = units, count
        self._rows: dict[bytes, np.ndarray] = {}
        self._same, self._noisy = 0, False
        self.answered = 0

    @staticmethod
    def of(units: UnitSpace) -> "Known | None":
        """For these parameters, if all are whole numbers."""
        count = units.count()
        return None if count is None else Known(units, count)

    @property
    def complete(self) -> bool:
        """Whether the function is known at all points of the grid."""
        return self._sure and len(self._rows) == self._count

    @property
    def _sure(self) -> bool:
        return self._same >= _ENOUGH and not self._noisy

    def rows(
        self,
        points: Float[Array, "K n"],
        layout: Layout,
        evaluate: Callable[[Float[Array, "k n"]], Float[Array, "k P"]],
    ) -> Float[Array, "K P"]:
        """What the function returns at these points, of which it is evaluated at the others."""
        names = self._names(points, layout)
        fresh = list(range(len(names)))
        if self._sure:
            fresh = [i for i in fresh if names[i] not in self._rows and names[i] not in names[:i]]
        new = {}
        if fresh:
            rows = np.asarray(evaluate(points[np.asarray(fresh)]))
            self._learn([names[i] for i in fresh], rows)
            if len(fresh) == len(names):
                return jnp.asarray(rows)
            new = {names[i]: row for i, row in zip(fresh, rows, strict=True)}
        self.answered += len(names) - len(fresh)
        return jnp.asarray(np.stack([new[n] if n in new else self._rows[n] for n in names]))

    def _names(self, points: Float[Array, "K n"], layout: Layout) -> list[bytes]:
        leaves = jax.tree.leaves(self._units.natural(layout.tree(points)))
        columns = np.concatenate([np.asarray(a).reshape(len(points), -1) for a in leaves], axis=1)
        return [row.tobytes() for row in columns]

    def _learn(self, names: list[bytes], rows: np.ndarray) -> None:
        for name, row in zip(names, rows, strict=True):
            if not np.all(np.isfinite(row)):
                continue  # it may have failed by chance
            before = self._rows.setdefault(name, row)
            if before is row:
                continue
            near = ROUNDING * np.finfo(row.dtype).eps * np.abs(before)
            if np.all(np.abs(row - before) <= near):
                self._same += 1
            else:
                self._noisy = True
