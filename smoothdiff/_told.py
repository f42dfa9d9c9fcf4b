"""What a `Search` is told: points and values, checked before anything of a call is taken in."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, PyTree

from smoothdiff._call_checks import check_squares
from smoothdiff._layout import layout_of
from smoothdiff._numbers import check_real, inexact
from smoothdiff._unit_space import UnitSpace


class Told:
    """Makes points unit vectors, and values rows; knows how many values came, and the lowest.

    `size` is the number of residuals, or 1, and None before it is known. `best` is the vector with
    the lowest value `fun`, None before there is one.
    """

    def __init__(self, y0: PyTree, space: PyTree, residuals: bool):
        """Of parameters like `y0`, in a space if there is one."""
        self.units = None if space is None else UnitSpace.of(y0, space)
        self.layout = layout_of(self.unit(y0))
        self.size: int | None = None
        self.count, self.fun = 0, float("inf")
        self.best: Float[np.ndarray, " n"] | None = None
        self._space, self._residuals = space, residuals
        self._like = _described(y0)

    def unit(self, y: PyTree) -> PyTree[Array]:
        """The unit coordinates of natural values."""
        return jax.tree.map(inexact, y if self.units is None else self.units.unit(y))

    def natural(self, y: PyTree) -> PyTree:
        """The natural values at unit coordinates."""
        return y if self.units is None else self.units.natural(y)

    def vector(self, point: PyTree) -> Float[np.ndarray, " n"]:
        """A point that nobody asked for.

        Raises:
            TypeError, ValueError: a point unlike the start, or that its space does not hold.
        """
        if (given := _described(point)) != self._like:
            raise ValueError(
                f"a point is {given[0]} of shapes {given[1]}, and y0 is {self._like[0]} of shapes"
                f" {self._like[1]}: tell a list of points that are like y0"
            )
        for leaf in jax.tree.leaves(point):
            check_real(leaf, "a point")
            if not np.all(np.isfinite(leaf)):
                raise ValueError(f"a point is not finite, {point}: leave it out")
        if self._space is not None:
            UnitSpace.of(point, self._space)
        return np.asarray(self.layout.vector(jax.tree.leaves(self.unit(point))))

    def rows(
        self, values: Sequence[Any], finite: bool
    ) -> tuple[int | None, list[Float[np.ndarray, " P"]]]:
        """How many numbers a row has, if that is known now; and the rows, NaN where one failed.

        Raises:
            TypeError, ValueError: what is no value; one that is not finite, if all have to be.
        """
        rows = [self._row(value) for value in values]
        given = [row for row in rows if not _failed(row)]
        size = self.size or (given[0].size if given else None)
        for row in given:
            if not self._residuals and row.size > 1:
                raise ValueError(
                    f"{row.size} numbers were told for a point: tell one number, or write "
                    "residuals=True if these are residuals"
                )
            if row.size != size:
                raise ValueError(
                    f"{row.size} residuals were told for a point, and {size} for another: tell "
                    "residuals of one shape"
                )
        if finite and not all(np.all(np.isfinite(row)) for row in rows):
            raise ValueError('a value is not finite: give the solver nonfinite="drop"')
        if self._residuals and self.size is None and given:
            check_squares(given[0])
        return size, [np.full(size or 1, np.nan, r.dtype) if _failed(r) else r for r in rows]

    def counted(self, vector: Float[np.ndarray, " n"], row: Float[np.ndarray, " P"]) -> None:
        """With a value more."""
        self.count += 1
        fun = float(row @ row / 2 if self._residuals else row[0])
        if np.isfinite(fun) and (self.best is None or fun < self.fun):
            self.best, self.fun = vector, fun

    def _row(self, value: Any) -> Float[np.ndarray, " P"]:
        leaves = jax.tree.leaves(value)
        if not sum(map(np.size, leaves)):
            raise ValueError(f"a value is {value}: tell NaN for an evaluation that failed")
        for leaf in leaves:
            check_real(leaf, "a value")
        return np.concatenate([np.ravel(np.asarray(leaf, self.layout.dtype)) for leaf in leaves])


def _described(y: PyTree) -> tuple[Any, list[tuple[int, ...]]]:
    """The structure and the shapes of a point."""
    return jax.tree.structure(y), list(map(np.shape, jax.tree.leaves(y)))


def _failed(row: Float[np.ndarray, " P"]) -> bool:
    """Whether one NaN stands for all that an evaluation would have returned."""
    return row.size == 1 and bool(np.isnan(row[0]))
