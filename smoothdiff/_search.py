"""`Search`: a solver that is asked for points and told their values, wherever they come from."""

from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from smoothdiff._call_checks import check_bounds, check_squares, check_start
from smoothdiff._default_solver import default_solver, share_of_range
from smoothdiff._devices import brought, computed_on_cpu
from smoothdiff._host_steps import HostSteps
from smoothdiff._layout import layout_of
from smoothdiff._params import as_key
from smoothdiff._run import inexact
from smoothdiff._solvers import AbstractSmoothSolver
from smoothdiff._solvers._base import write_options
from smoothdiff._solvers._box import bounds_of
from smoothdiff._solvers._stages import LOOK, TRUST
from smoothdiff._unit_space import UnitSpace

# a point is given out again once so many others were told, for each that is out, and some more
_LOST, _SOME = 2, 4
# two programs may give the same point with so many roundings between
_ROUNDINGS = 8


class Search:
    """A search that the caller steers: `ask` for points, evaluate them anywhere, `tell` the values.

    Points may be told in any order. Some may be missing, or have failed with a NaN. More may be
    asked for before all are told, so no worker waits for the slowest. Values at points that were
    never asked for teach as well, so earlier evaluations can be told at the beginning.

    To save a search, pickle it: it goes on where it was, with the same version of smoothdiff. For
    other versions keep its points and values. A new search with the same key that is told the same
    values in the same calls, with none still out, goes on where the old one was.

    `ask` gives what the model wants next. If that is still out, further points follow: in the local
    model shorter and longer steps and points beside them, in a round of samples its next ones. A
    point that nobody tells is given out again, after twice as many others as are out. One point at
    a time, these are the steps of `minimise` and `least_squares`.

    Args:
        y0: where to start, a pytree of numbers and arrays.
        key: a random key.
        residuals: whether each point is told its residuals, of which half the sum of squares is
            minimised. If not, it is told one number.
        solver: a `NewtonCG`, or with residuals a `GaussNewton`, for fewer than 100 parameters. By
            default as for `minimise`. Failed evaluations need `nonfinite="drop"`.
        sigma: of the default solver, as for `minimise`.
        space: as for `minimise`.
        bounds: as for `minimise`.
        takes_key: whether the function draws random numbers, as for `minimise`. `search.key` is the
            key for the points that are asked for next; numbers of another origin are as good.

    Raises:
        TypeError, ValueError: an argument that cannot work.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> search = sd.Search(jnp.zeros(2), key=jax.random.key(0))
        >>> for _ in range(20):
        ...     points = search.ask(2)
        ...     search.tell(points, [(y[0] - 1) ** 2 + (y[1] + 2) ** 2 for y in points])
        >>> [round(float(y), 2) for y in search.y]
        [1.0, -2.0]

    Source: own.
    """

    @computed_on_cpu
    def __init__(
        self,
        y0: PyTree,
        *,
        key: Any,
        residuals: bool = False,
        solver: Any = None,
        sigma: PyTree = None,
        space: PyTree = None,
        bounds: tuple[PyTree, PyTree] | None = None,
        takes_key: bool = False,
    ):
        check_start(y0)
        check_bounds(bounds, y0, space)
        self._units = None if space is None else UnitSpace.of(y0, space)
        if (units := self._units) is not None:
            bounds = units.bounds()
            if solver is None and sigma is None:
                sigma = units.sigma(share_of_range(units.unit(y0), bounds, residuals))
        self._y = brought(self._unit(y0))
        if solver is None:
            solver = default_solver(self._y, bounds, sigma, residuals)
        if not isinstance(solver, AbstractSmoothSolver) or solver.sizes(self._y) is None:
            raise TypeError(
                "a search evaluates point by point: give NewtonCG, or GaussNewton with residuals, "
                "for fewer than 100 parameters and with a constant sigma"
            )
        if getattr(solver, "squares", None) != residuals:
            raise TypeError(
                f"{type(solver).__name__} is not for this: write residuals={not residuals}"
            )
        self.solver: Any = solver
        options = write_options(key, bounds, takes_key)
        self._key, self._takes_key = as_key(key), takes_key
        self._steps = HostSteps.of(*brought((solver, options, self._y)))
        self._layout, self._random = layout_of(self._y), np.random.default_rng(0)
        self._size: int | None = None
        self._over = False
        self._state = self._first(1)
        # unit vectors that are out, with their natural values and how many were told before
        self._out: dict[bytes, tuple[np.ndarray, bytes, int]] = {}
        # rows that came, and wait for what the model asks for before them
        self._came: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

    @property
    def y(self) -> PyTree:
        """The lowest point of those that were told; with `takes_key` the solver's iterate."""
        y = self._y if self._takes_key else self._state.progress.lowest_y
        return self._natural(jax.tree.map(jnp.asarray, y))

    @property
    def fun(self) -> float:
        """The lowest value, or half the sum of squares; infinite before anything was told."""
        return self._state.progress.lowest_fun.item()

    @property
    def evaluations(self) -> int:
        """How many values were told."""
        return self._state.progress.evaluations.item() + len(self._came)

    @property
    @computed_on_cpu
    def key(self) -> Array:
        """For a function that draws random numbers: those of the points that are asked for next.

        It changes only when values are told, and is the same for evaluations that are compared.
        """
        if not self._takes_key:
            raise ValueError("there is a key for a function that takes one: write takes_key=True")
        return self._steps.parts(self._y, self._state).numbers((None, self._key))[1]

    @property
    def done(self) -> bool:
        """Whether the solver would stop here; more can be asked for."""
        return self._over

    @computed_on_cpu
    def ask(self, count: int = 1) -> list[PyTree[np.ndarray]]:
        """The next points to evaluate, so many of them."""
        late = self.evaluations - _SOME - _LOST * len(self._out)
        self._out = {unit: out for unit, out in self._out.items() if out[2] > late}
        given: list[PyTree] = []
        for vector in self._wanted(count + len(self._out)):
            unit = vector.tobytes()
            if unit in self._out or unit in self._came:
                continue
            point = jax.device_get(self._natural(self._layout.tree(jnp.asarray(vector))))
            self._out[unit] = vector, _bytes(point), self.evaluations
            given.append(point)
            if len(given) == count:
                break
        return given

    @computed_on_cpu
    def tell(self, points: Sequence[PyTree], values: Sequence[Any]) -> None:
        """The values at these points; NaN for an evaluation that failed.

        Raises:
            ValueError: another number of values, or of residuals; a NaN that the solver refuses.
        """
        if len(points) != len(values):
            raise ValueError(f"{len(points)} points but {len(values)} values: tell one for each")
        rows = [self._row(value) for value in values]
        for point, row in zip(points, rows, strict=True):
            same = [u for u, out in self._out.items() if out[1] == _bytes(point)]
            vectors = [self._out.pop(unit)[0] for unit in same] or [self._vector(point)]
            for vector in vectors:
                self._came[vector.tobytes()] = vector, row
        while self._digested():
            pass

    def _digested(self) -> bool:
        """Takes in what the model asks for next if that came; else what it no longer asks for."""
        points, proposal = self._steps.propose(self._y, self._state, 1)
        if (unit := self._same(np.asarray(points[0]))) is not None:
            known = (jnp.asarray(a)[None] for a in self._came.pop(unit))
            told = self._steps.told(self._y, self._state, *known, proposal)
            self._y, self._state, over = told
            self._over = bool(over)
            return True
        later = set()
        if self._state.search.stage != TRUST and self._came:
            later = {v.tobytes() for v in self._round(len(self._came) + len(self._out) + 1)}
        for unit in [unit for unit in self._came if unit not in later]:
            vector, row = self._came.pop(unit)
            known = jnp.asarray(vector)[None], jnp.asarray(row)[None]
            self._state = self._steps.learnt(self._y, self._state, *known)
            return True
        return False

    def _same(self, point: np.ndarray) -> bytes | None:
        """What came of this point, which may be rounded otherwise in a program for more of them."""
        if (unit := point.tobytes()) in self._came:
            return unit
        if not self._came or self._state.search.stage == TRUST:  # that comes from one program
            return None
        params = self._steps.parts(self._y, self._state).params()
        size = np.abs(point) + np.asarray(params.sigma)
        if self._state.search.stage == LOOK:
            size += sum(np.abs(np.asarray(side)) for side in bounds_of(params))
        away = {u: np.max(np.abs(came[0] - point) / size) for u, came in self._came.items()}
        nearest = min(away, key=away.__getitem__)
        return nearest if away[nearest] <= _ROUNDINGS * np.finfo(point.dtype).eps else None

    def _wanted(self, count: int) -> Iterator[np.ndarray]:
        """What to evaluate next, in this order, without end."""
        search = self._state.search
        if search.stage != TRUST:
            yield from self._round(count)
        else:
            # what comes of it is taken in as a step, so it must be the same to the last bit
            yield np.asarray(self._steps.propose(self._y, self._state, 1)[0][0])
            if count > 1:
                yield from self._round(count)[1:]
        params = self._steps.parts(self._y, self._state).params()
        sigma, here = np.asarray(params.sigma), np.asarray(search.iterate())
        # so wide that there are other points, where a radius has come to nothing
        least = np.sqrt(np.finfo(here.dtype).eps) * np.maximum(sigma, np.abs(here))
        width = np.maximum(sigma * np.asarray(search.width()), least)
        while True:
            yield self._clipped(here + width * self._random.standard_normal(width.shape))

    def _round(self, count: int) -> list[np.ndarray]:
        """The next points of this round, and of no later one; or a step and points beside it."""
        # a power of two, since it is compiled for each
        count = 1 << (count - 1).bit_length()
        return list(np.asarray(self._steps.propose(self._y, self._state, count)[0]))

    def _clipped(self, vector: np.ndarray) -> np.ndarray:
        params = self._steps.parts(self._y, self._state).params()
        return np.asarray(params.clip(jnp.asarray(vector, params.theta.dtype)))

    def _natural(self, y: PyTree) -> PyTree:
        return y if self._units is None else self._units.natural(y)

    def _unit(self, y: PyTree) -> PyTree[Array]:
        return jax.tree.map(inexact, y if self._units is None else self._units.unit(y))

    def _vector(self, point: PyTree) -> np.ndarray:
        return np.asarray(self._layout.vector(jax.tree.leaves(self._unit(point))))

    def _row(self, value: Any) -> np.ndarray:
        leaves = [np.ravel(np.asarray(leaf)) for leaf in jax.tree.leaves(value)]
        row = np.concatenate(leaves).astype(self._layout.dtype)
        if self._size is None and not (row.size == 1 and np.isnan(row[0])):
            if self.solver.squares:
                check_squares(row)
            self._size = row.size
            self._state = self._first(row.size) if row.size > 1 else self._state
        if row.size == 1 and np.isnan(row[0]):
            row = np.full(self._size or 1, np.nan, row.dtype)
        if row.size != (self._size or 1) or (row.size > 1 and not self.solver.squares):
            raise ValueError(
                f"{row.size} numbers were told for a point, not {self._size}: tell "
                + ("residuals of one shape" if self.solver.squares else "one number, or residuals")
            )
        if self.solver.nonfinite == "propagate" and not np.all(np.isfinite(row)):
            raise ValueError('a value is not finite: give the solver nonfinite="drop"')
        return row

    def _first(self, size: int) -> Any:
        out = jax.ShapeDtypeStruct((size,) if self.solver.squares else (), self._layout.dtype)
        return self._steps.init(self._y, out)


def _bytes(point: PyTree) -> bytes:
    return b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(point))
