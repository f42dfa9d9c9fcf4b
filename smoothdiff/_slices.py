"""Slices: a function and its smoothed one along single parameters through a point."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from smoothdiff._call_checks import returned
from smoothdiff._params import Params, take_apart
from smoothdiff._ranges import Integer
from smoothdiff._samplers import Sobol
from smoothdiff._smooth import smooth
from smoothdiff._solvers._evaluator import called
from smoothdiff._spaces import AbstractSpace
from smoothdiff._unbounded import Periodic
from smoothdiff._unit_space import UnitSpace

# Sets of points whose spread tells the error, and Student's t for 95 % with one degree of freedom
# less: 93 to 96 % of such intervals held the smoothed value, of four functions in two and eight
# dimensions, by hand. The default baseline is more accurate, but cannot say by how much.
_SETS, _WITHIN = 4, 3.18
# where nothing ends a line, it goes so many sigma to either side
_REACH = 4.0
_MOST = 36


class Line(NamedTuple):
    """One slice, in NumPy arrays of a number for each point.

    Attributes:
        x: where, in natural values.
        fun: the function.
        smoothed: the smoothed function.
        error: half of its 95 % interval.
        here: which of the points the slices go through.
        whole: whether the parameter is a whole number.
        scale: "linear" or "log", of `x`.
    """

    x: np.ndarray
    fun: np.ndarray
    smoothed: np.ndarray
    error: np.ndarray
    here: int
    whole: bool
    scale: str


@dataclass(frozen=True)
class Slices:
    """All slices through a point; `labels` has a name for each number of the parameters."""

    units: UnitSpace
    params: Params
    labels: list[str]
    points: int
    values: Callable[[Any, Array], tuple]

    @staticmethod
    def of(
        fun: Callable[[PyTree, PyTree], Any],
        y: PyTree,
        args: PyTree,
        sigma: PyTree,
        key: Any,
        space: PyTree,
        labels: Sequence[str] | None,
        points: int,
        num_samples: int,
    ) -> "Slices":
        """Checks the arguments of `plot.slice`; evaluates nothing."""
        if points < 3:
            raise ValueError(f"points={points} make no line: take 3 or more")
        units = UnitSpace.of(y, space)
        start, bounds = units.unit(y), units.bounds()
        sigma = units.sigma() if sigma is None else sigma
        if not jax.tree.leaves(sigma):
            raise ValueError("a slice needs a width: give sigma=..., or a space, which has one")
        names = units.labels() if labels is None else list(labels)
        if len(names) != len(units.labels()):
            raise ValueError(
                f"there are {len(names)} labels for {len(units.labels())} parameters: give one for "
                "each"
            )
        natural = units.wrap(fun)
        wrapped = lambda u, args: called(natural, u, args)
        out = jax.eval_shape(wrapped, start, args)
        if [leaf.shape for leaf in jax.tree.leaves(out)] != [()]:
            raise TypeError(
                f"{returned(out)}; it must return one number: for residuals, give "
                "lambda y, args: jnp.sum(residuals(y, args) ** 2) / 2"
            )
        params = take_apart(start, sigma, bounds)
        smoothed = smooth(
            wrapped,
            sigma,
            num_samples=num_samples,
            sampler=Sobol(replicates=_SETS),
            baseline="mean",
            bounds=bounds,
            stderr=True,
        )

        @jax.jit
        def values(j: Any, grid: Array) -> tuple:
            def at(t: Array) -> tuple:
                u = params.layout.tree(params.theta.at[j].set(t), params.free)
                x = params.layout.vector(jax.tree.leaves(units.axis(u)))[j]
                return x, wrapped(u, args), *smoothed(key, u, args)

            return jax.lax.map(at, grid)

        return Slices(units, params, names, points, values)

    def all(self) -> list[int]:
        """The positions of all parameters that are smoothed.

        Raises:
            ValueError: they are too many to look at.
        """
        found = np.flatnonzero(self._smoothed()).tolist()
        if len(found) > _MOST:
            raise ValueError(
                f"{len(found)} parameters are too many for one figure: choose one, such as "
                f"parameter={self.labels[found[0]]!r}"
            )
        return found

    def position(self, parameter: int | str) -> int:
        """Which of all numbers a parameter is.

        Raises:
            ValueError: there is none of that position or label; its sigma is None.
        """
        known = self.labels.index(parameter) if parameter in self.labels else parameter
        count = len(self.labels)
        if not isinstance(known, int | np.integer) or not -count <= known < count:
            shown = ", ".join(self.labels[:_MOST])
            raise ValueError(f"there is no parameter {parameter!r}: the parameters are {shown}")
        j = int(known) % count
        if not self._smoothed()[j]:
            raise ValueError(
                f"the parameter {self.labels[j]} is not smoothed: give it a sigma, or a space"
            )
        return j

    def along(self, j: int) -> Line:
        """Evaluates the function and its smoothed one along one parameter."""
        space = self.units.spaces[self._leaves()[j]]
        among = int(np.sum(self._smoothed()[:j]))
        here, grid = self._grid(j, space, self.params.theta[among], self.params.sigma[among])
        x, fun, smoothed, stderr = (np.asarray(a, float) for a in self.values(among, grid))
        scale = "linear" if space is None else space.axis_scale
        return Line(x, fun, smoothed, _WITHIN * stderr, here, isinstance(space, Integer), scale)

    def _grid(
        self, j: int, space: AbstractSpace | None, here: Array, sigma: Array
    ) -> tuple[int, Float[Array, " points"]]:
        """Which of the unit coordinates in a row is the point itself, and these."""
        if isinstance(space, Integer) and (count := self._count(j, space)) <= self.points:
            grid = (jnp.arange(count).astype(here.dtype) + 0.5) / count
            return int(jnp.argmin(jnp.abs(grid - here))), grid
        if isinstance(space, Periodic):
            low = jnp.floor(here)
            high = low + 1
        elif space is not None and np.all(np.isfinite(space.unit_bounds)):
            low, high = space.unit_bounds
        else:
            low, high = here - _REACH * sigma, here + _REACH * sigma
        grid = jnp.linspace(low, high, self.points - 1, dtype=here.dtype)
        at = int(jnp.searchsorted(grid, here))
        return at, jnp.insert(grid, at, here)

    def _count(self, j: int, space: Integer) -> int:
        """How many whole numbers there are of one parameter."""
        leaf = self._leaves()[j]
        counts = np.subtract(space.high, space.low) + 1
        first = int(np.searchsorted(self._leaves(), leaf))
        return int(np.broadcast_to(counts, self.units.shapes[leaf]).flat[j - first])

    def _leaves(self) -> np.ndarray:
        """For each number the leaf that it is in."""
        sizes = [int(np.prod(shape)) for shape in self.units.shapes]
        return np.repeat(np.arange(len(sizes)), sizes)

    def _smoothed(self) -> np.ndarray:
        return np.asarray(self.params.layout.smoothed)[self._leaves()]
