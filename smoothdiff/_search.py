"""`Search`: a solver that is asked for points and told their values, wherever they come from."""

import itertools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from smoothdiff._call_checks import check_bounds, check_start
from smoothdiff._default_solver import default_solver, share_of_range
from smoothdiff._devices import brought, computed_on_cpu
from smoothdiff._host_steps import HostSteps
from smoothdiff._numbers import check_whole
from smoothdiff._params import as_key
from smoothdiff._solvers import AbstractSmoothSolver
from smoothdiff._solvers._base import write_options
from smoothdiff._solvers._box import has_box
from smoothdiff._solvers._stages import LOOK, TRUST
from smoothdiff._told import Told

# a point is given out again once so many others were told, for each that is out, and some more
_LOST, _SOME = 2, 4
# two programs may give the same point with so many roundings between
_ROUNDINGS = 8
# so many points of no model are near the iterate
_NEARBY = 16


class _Out(NamedTuple):
    """The unit vectors that have the natural values of a point, and how many were told before."""

    vectors: list[np.ndarray]
    before: int


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
        self._told = Told(y0, space, residuals)
        if (units := self._told.units) is not None:
            bounds = units.bounds()
            if solver is None and sigma is None:
                sigma = units.sigma(share_of_range(units.unit(y0), bounds, residuals))
        self._y = brought(self._told.unit(y0))
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
        self._random = np.random.default_rng(0)
        self._over = False
        self._state = self._first(1)
        # by the bytes of the natural values
        self._out: dict[bytes, _Out] = {}
        # by the bytes of the unit vector, rows that came and wait for what is asked for before
        self._came: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

    @property
    def y(self) -> PyTree:
        """The lowest point of those that were told; with `takes_key` the solver's iterate.

        It is the start before any value is known.
        """
        best = self._told.best
        y = self._y if self._takes_key or best is None else self._told.layout.tree(best)
        return self._told.natural(jax.tree.map(jnp.asarray, y))

    @property
    def fun(self) -> float:
        """The lowest value, or half the sum of squares; infinite before any value is known."""
        return self._told.fun

    @property
    def evaluations(self) -> int:
        """How many values were told."""
        return self._told.count

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
        """The next points to evaluate, so many of them.

        They differ from all that are out, unless all whole numbers are.

        Raises:
            TypeError, ValueError: a count that is not whole, or negative.
        """
        check_whole(count, "count")
        if (count := int(count)) < 0:
            raise ValueError(f"count must be 0 or more, not {count}")
        late = self.evaluations - _SOME - _LOST * len(self._out)
        self._out = {name: out for name, out in self._out.items() if out.before > late}
        out = {vector.tobytes() for vector in self._vectors_out()}
        wanted = self._wanted(count + len(out)) if count else iter(())
        units, given = self._told.units, list[PyTree]()
        grid = None if units is None else units.count()
        while len(given) < count:
            vector, asked = next(wanted)
            known = (unit := vector.tobytes()) in out or unit in self._came
            full = grid is not None and len(self._out) >= grid
            if known and not full:
                continue
            out.add(unit)
            point = jax.device_get(self._told.natural(self._told.layout.tree(jnp.asarray(vector))))
            if (same := self._out.get(_bytes(point))) is None:
                self._out[_bytes(point)] = _Out([vector], self.evaluations)
            elif asked and not known:
                same.vectors.append(vector)  # the value will be that of both
            if same is None or full:
                given.append(point)
        return given

    @computed_on_cpu
    def tell(self, points: Sequence[PyTree], values: Sequence[Any]) -> None:
        """The values at these points; NaN for an evaluation that failed.

        Raises:
            TypeError, ValueError: another number of values, or of residuals; a NaN that the solver
                refuses; a point beyond the bounds, or of other shapes than y0. Then nothing of the
                call is taken in.
        """
        if len(points) != len(values):
            raise ValueError(f"{len(points)} points but {len(values)} values: tell one for each")
        told, names = self._told, list(map(_bytes, points))
        vectors = [
            self._out[name].vectors if name in self._out else [self._within(point)]
            for name, point in zip(names, points, strict=True)
        ]
        size, rows = told.rows(values, finite=self.solver.nonfinite == "propagate")
        if told.size is None and size is not None:
            self._sized(size)
        for name, alike, row in zip(names, vectors, rows, strict=True):
            told.counted(alike[0], row)
            # if a point is told twice in one call, only its first vector gets the second value
            for vector in alike if self._out.pop(name, None) else alike[:1]:
                self._take(vector, row)
        self._digest()

    def _sized(self, size: int) -> None:
        """Of so many numbers is a row, it is known now; what came before had failed."""
        if size > 1:
            self._state = self._first(size)
            self._came = {u: (v, np.resize(row, size)) for u, (v, row) in self._came.items()}
        self._told.size = size

    def _take(self, vector: np.ndarray, row: np.ndarray) -> None:
        """Keeps a row until it is asked for; one that the same point had before is learnt."""
        if (unit := vector.tobytes()) in self._came:
            self._digest()
            if unit in self._came:
                self._learn(unit)
        self._came[unit] = vector, row

    def _learn(self, unit: bytes) -> None:
        """Takes in what came, whatever the model asks for next."""
        vector, row = self._came.pop(unit)
        known = jnp.asarray(vector)[None], jnp.asarray(row)[None]
        self._state = self._steps.learnt(self._y, self._state, *known)

    def _digest(self) -> None:
        """Takes in all that can be."""
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
            later = {
                v.tobytes() for v in self._round(len(self._came) + len(self._vectors_out()) + 1)
            }
        early = next((unit for unit in self._came if unit not in later), None)
        if early is not None:
            self._learn(early)
        return early is not None

    def _same(self, point: np.ndarray) -> bytes | None:
        """What came of this point, which may be rounded otherwise in a program for more of them."""
        if (unit := point.tobytes()) in self._came:
            return unit
        if not self._came or self._state.search.stage == TRUST:  # that comes from one program
            return None
        params = self._steps.parts(self._y, self._state).params()
        size = np.abs(point) + np.asarray(params.sigma)
        if self._state.search.stage == LOOK:
            for side in params.bounds or ():
                size += np.where(np.isfinite(side), np.abs(side), 0)
        away = {u: np.max(np.abs(came[0] - point) / size) for u, came in self._came.items()}
        nearest = min(away, key=away.__getitem__)
        return nearest if away[nearest] <= _ROUNDINGS * np.finfo(point.dtype).eps else None

    def _wanted(self, count: int) -> Iterator[tuple[np.ndarray, bool]]:
        """What to evaluate next, in this order, without end; and whether the model asked for it."""
        search = self._state.search
        if search.stage != TRUST:
            yield from ((vector, True) for vector in self._round(count))
        else:
            # what comes of it is taken in as a step, so it must be the same to the last bit
            yield np.asarray(self._steps.propose(self._y, self._state, 1)[0][0]), True
            if count > 1:
                yield from ((vector, True) for vector in self._round(count)[1:])
        params = self._steps.parts(self._y, self._state).params()
        sigma, here = np.asarray(params.sigma), np.asarray(search.iterate())
        # so wide that there are other points, where a radius has come to nothing
        least = np.sqrt(np.finfo(here.dtype).eps) * np.maximum(sigma, np.abs(here))
        width = np.maximum(sigma * np.asarray(search.width()), least)
        box = params.bounds if has_box(params) else None
        for k in itertools.count():
            # whole numbers nearby may all be out
            if box is not None and k >= _NEARBY:
                low, high = map(np.asarray, box)
                point = self._random.uniform(low, high)
            else:
                wider = max(1, k / _NEARBY)
                point = here + wider * width * self._random.standard_normal(width.shape)
            yield np.asarray(params.clip(jnp.asarray(point, here.dtype))), False

    def _round(self, count: int) -> list[np.ndarray]:
        """The next points of this round, and of no later one; or a step and points beside it."""
        # a power of two, since it is compiled for each
        count = 1 << (count - 1).bit_length()
        return list(np.asarray(self._steps.propose(self._y, self._state, count)[0]))

    def _vectors_out(self) -> list[np.ndarray]:
        return [vector for each in self._out.values() for vector in each.vectors]

    def _within(self, point: PyTree) -> np.ndarray:
        """The unit vector of a point that was not asked for, if it is within the bounds."""
        vector = self._told.vector(point)
        if not np.array_equal(vector, self._clipped(vector)):
            raise ValueError(
                f"the point {point} lies outside its bounds: leave it out, or widen them"
            )
        return vector

    def _clipped(self, vector: np.ndarray) -> np.ndarray:
        params = self._steps.parts(self._y, self._state).params()
        return np.asarray(params.clip(jnp.asarray(vector, params.theta.dtype)))

    def _first(self, size: int) -> Any:
        out = jax.ShapeDtypeStruct((size,) if self.solver.squares else (), self._told.layout.dtype)
        return self._steps.init(self._y, out)


def _bytes(point: PyTree) -> bytes:
    return b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(point))
