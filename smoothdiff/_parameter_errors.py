"""The errors of least-squares parameters in natural values, from the evaluations of a run."""

import dataclasses
import warnings
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from smoothdiff._covariance import Covariance, covariance, slopes
from smoothdiff._layout import layout_of, vectors
from smoothdiff._params import side_leaves
from smoothdiff._solvers._history import History
from smoothdiff._unit_space import UnitSpace


class Answer(NamedTuple):
    """Where a run ended: the point in unit coordinates, and further evaluations around it."""

    y: PyTree[Array]
    units: UnitSpace
    bounds: tuple[PyTree, PyTree] | None
    more: tuple[tuple[np.ndarray, np.ndarray], ...] = ()

    def vector(self) -> np.ndarray:
        """The point."""
        return np.asarray(layout_of(self.y).vector(jax.tree.leaves(self.y)))

    def sides(self) -> tuple[np.ndarray, np.ndarray]:
        """The bounds, infinite where there are none."""
        low, high = self.bounds or (None, None)
        layout = layout_of(self.y)
        low = layout.vector(side_leaves(low, -np.inf, self.y))
        high = layout.vector(side_leaves(high, np.inf, self.y))
        return np.asarray(low), np.asarray(high)

    def with_rows(self, points: Float[np.ndarray, "m n"], rows: Float[Array, "m P"]) -> "Answer":
        """With the residuals at further points; those that are not finite are left out."""
        values = np.asarray(rows)
        good = np.all(np.isfinite(values), axis=1)
        return self._replace(more=(*self.more, (points[good], values[good])))

    def evaluations(self, history: History) -> tuple[np.ndarray, np.ndarray, int | None]:
        """All points and their residuals, and which of them is this one, if any is."""
        valid = np.asarray(history.valid)
        points, rows = np.asarray(history.points)[valid], np.asarray(history.rows)[valid]
        points = np.concatenate([points, *(point for point, _ in self.more)])
        rows = np.concatenate([rows, *(row for _, row in self.more)])
        # as the function saw them, where leaves have other dtypes than the vector
        seen = vectors(layout_of(self.y).tree(points))
        here = np.flatnonzero(np.all(seen == self.vector(), axis=1))
        return points, rows, int(here[-1]) if len(here) else None


@dataclasses.dataclass(frozen=True)
class ParameterErrors:
    """Errors at a point `y` in natural values; NaN where they are not known."""

    y: PyTree
    answer: Answer
    unit: Covariance

    @staticmethod
    def of(
        y: PyTree, answer: Answer, history: History, fun: float, takes_key: bool
    ) -> "ParameterErrors":
        """From the evaluations in the history, for half a sum of squares `fun`.

        Warns of what is not known, and why.
        """
        here, low, high = answer.vector(), *answer.sides()
        fixed, names = (here <= low) | (here >= high), np.asarray(answer.units.labels())
        residuals = history.rows.shape[1]
        unit = covariance(slopes(*answer.evaluations(history)), residuals, 2 * fun, fixed)
        unknown = ~fixed & np.isnan(np.diag(unit.matrix))
        said = []
        if np.any(fixed):
            which = _listed(names[fixed])
            said.append(f"no error of {which}, at a bound; the others are for it fixed there")
        if unit.freedom < 1:
            said.append(
                f"no errors from {residuals} residuals of {np.sum(~fixed)} parameters: there must "
                "be more residuals than parameters"
            )
        elif np.any(unknown):
            said.append(
                f"no error of {_listed(names[unknown])}, and the others are for them as they are: "
                "the evaluations do not tell how the residuals depend on them. "
                + _why(bool(answer.more), 2 * int(np.sum(~fixed)), takes_key)
            )
        if said:
            warnings.warn("; ".join(said), stacklevel=5)
        return ParameterErrors(y, answer, unit)

    @property
    def covariance(self) -> Float[Array, "n n"]:
        """That of the natural values, by their slopes at the point."""
        units, y = self.answer.units, self.answer.y
        ones = jax.tree.map(jnp.ones_like, y)
        slope = self._vector(jax.jvp(units.axis, (y,), (ones,))[1])
        return jnp.asarray(self.unit.matrix * slope * slope[:, None], self._dtype())

    @property
    def standard(self) -> PyTree[Array]:
        """The roots of the variances."""
        return layout_of(self.answer.y).tree(jnp.sqrt(jnp.diagonal(self.covariance)))

    def intervals(self, level: float) -> tuple[PyTree, PyTree]:
        """Low and high ends, symmetric in unit coordinates."""
        # SciPy's special functions take a tenth of a second to import
        from scipy.special import stdtrit

        units, layout = self.answer.units, layout_of(self.answer.y)
        reach = stdtrit(self.unit.freedom, (1 + level) / 2) * np.sqrt(np.diag(self.unit.matrix))
        here = self.answer.vector()
        ends = []
        for end in (here - reach, here + reach):
            there = units.axis(layout.tree(jnp.asarray(end, self._dtype())))
            # an angle stays in the period of y
            away = jax.tree.map(lambda a, b: a - b, there, units.axis(self.answer.y))
            ends.append(jax.tree.map(lambda a, b: jnp.asarray(a).astype(b.dtype) + b, self.y, away))
        return ends[0], ends[1]

    def _vector(self, tree: PyTree) -> np.ndarray:
        return np.asarray(layout_of(self.answer.y).vector(jax.tree.leaves(tree)), float)

    def _dtype(self) -> np.dtype:
        return layout_of(self.answer.y).dtype


def _why(further: bool, count: int, takes_key: bool) -> str:
    """What may help, before and after `with_covariance`."""
    call = f"sd.with_covariance(fun, result, args{', key=key' if takes_key else ''})"
    if takes_key and not further:
        return (
            "Those of a run whose function takes a key have several, which differ by more than "
            f"slopes do. It takes the {count} evaluations of {call}, which have one"
        )
    if not further:
        return (
            "Either they do not, or only on a combination, or it takes the "
            f"{count} evaluations of {call}"
        )
    return (
        "Either they do not, or only on a combination, or they jump or curve as near as was "
        f"looked. Then call {call} again, which looks in other directions, or make the function "
        "smoother, by finer time steps say"
    )


def _listed(names: np.ndarray) -> str:
    return ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
