"""`coarse_to_fine`: a search on a cheap version of a function, then on dearer ones."""

import dataclasses
import itertools
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import PyTree

from smoothdiff._levels import CoarseToFine, Level, check_levels
from smoothdiff._limits import NoRoomError
from smoothdiff._params import as_key
from smoothdiff._result import Record, Result

# a coarse level ends where the lowest value fell by less than this share within its patience, which
# is counted in evaluations per parameter and one more
_PROGRESS, _LEAST, _MOST = 0.1, 6, 20
_TINY = 1e-300
# why all ends with a level; and why the finest one does where it found what it could
_ENDED = "interrupted", "max_evaluations", "max_seconds"
_WELL = "converged", "stalled", "noise"


def coarse_to_fine(
    minimiser: Callable[..., Result],
    levels: Sequence[Level],
    y0: PyTree,
    args: PyTree = None,
    *,
    key: Any,
    target: float | None = None,
    max_cost: float | None = None,
    max_seconds: float | None = None,
    callback: Callable[[Record], Any] | None = None,
    **options: Any,
) -> CoarseToFine:
    r"""Minimises a function by way of cheaper versions of it: fewer pixels, samples or time steps.

    $$ y_k \approx \arg\min_y f_k(y) \text{ from } y_{k-1}, \qquad
       \sigma_k = \sigma_{k-1} \sqrt{c_{k-1} / c_k} $$

    Far from the answer a cheap version says as much as a dear one, and a picture of few pixels has
    fewer local minima. The search leaves a level that has little more to tell: one whose lowest
    value has fallen by less than a tenth during its last evaluations, as many as cost what the
    first n + 1 of the next level do (at least 6 (n + 1), at most 20 (n + 1)). The next level begins
    at the best point. Its sigma is smaller, because its error is: the width of a pixel and the
    noise of random samples both fall with the root of their cost. The finest level ends as any
    search does.

    If `y0` has a lower value than the answer, by the finest level, that level is searched once more
    from `y0`.

    Args:
        minimiser: `minimise` or `least_squares`.
        levels: from the coarsest, which is the cheapest, to the finest, which is the function
            itself.
        y0: where to start.
        args: passed on to the functions.
        key: a random key.
        target: a value of the finest level that is good enough.
        max_cost: the most that all evaluations may cost, in evaluations of the finest level.
        max_seconds: seconds after which no further step begins.
        callback: called with each step's `Record`; the search ends if it returns something true.
        **options: as for the minimiser: `bounds`, `space`, `sigma`, `solver`, `support`,
            `progress`, `takes_key`. Sigma and a solver are for the coarsest level; later ones have
            a smaller sigma. The steps of the default solver are smaller with it. Those of a
            `FirstOrder` that you give are as large as its `optim` makes them, on all levels.

    Returns:
        A `CoarseToFine`.

    Raises:
        TypeError, ValueError: levels without costs, or from fine to coarse; a solver within another
            one; no room for a step; as the minimiser.
        MinimiseError: as the minimiser.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> def bar(pixels):
        ...     x = (jnp.arange(pixels) + 0.5) / pixels
        ...     draw = lambda y: jnp.where(jnp.abs(x - y) < 0.1, 1.0, 0.0)
        ...     return sd.Level(lambda y, args: draw(y) - draw(0.7), cost=pixels)
        >>> found = sd.coarse_to_fine(
        ...     sd.least_squares, [bar(16), bar(256)], 0.4, key=jax.random.key(0), bounds=(0, 1)
        ... )
        >>> round(float(found.y), 2)
        0.7

    Source: own; continuation from coarse to fine as for image pyramids (Burt and Adelson, 1983).
    """
    check_levels(levels, max_cost, options)
    unit = float(levels[-1].cost)
    search = _Search(minimiser, unit, args, as_key(key), max_cost, max_seconds, options)
    y = y0
    for level, dearer in itertools.pairwise(levels):
        stall = _Stall(_patience(level, dearer, y0), callback)
        found = search.run(level, y, callback=stall)
        if stall.asked or found.reason in _ENDED:
            return search.found(found.reason)
        if not search.room(dearer, y0):
            return search.found("max_cost")
        y = found.y
        search.narrower(level.cost / dearer.cost)
    found = search.run(levels[-1], y, callback=callback, target=target)
    again = len(levels) > 1 and search.room(levels[-1], y0, search.looks) and found.reason in _WELL
    # one that was led astray
    if again and search.lower(levels[-1], y0):
        found = search.again(levels[-1], y0, callback=callback, target=target)
    return search.found(found.reason)


@dataclasses.dataclass
class _Stall:
    """A callback that ends a level whose lowest value falls too slowly."""

    patience: int
    callback: Callable[[Record], Any] | None
    asked: bool = False
    mark: tuple[float, int] = (math.inf, 0)

    def __call__(self, record: Record) -> bool:
        self.asked = self.callback is not None and bool(self.callback(record))
        value, since = self.mark
        # values may be negative, and a tenth of them says nothing then
        if not record.fun >= value - _PROGRESS * abs(value):
            self.mark = record.fun, record.evaluations
        return self.asked or record.evaluations - since >= self.patience


@dataclasses.dataclass
class _Search:
    """A search in progress: what was found, what it cost, and the options from now on."""

    minimiser: Callable[..., Result]
    unit: float
    args: PyTree
    key: Any
    max_cost: float | None
    max_seconds: float | None
    options: dict[str, Any]
    results: list[Result] = dataclasses.field(default_factory=list)
    counts: list[int] = dataclasses.field(default_factory=list)
    cost: float = 0.0
    start: float = dataclasses.field(default_factory=time.monotonic)

    def run(self, level: Level, y: PyTree, **ends: Any) -> Result:
        """The search of a level."""
        if self.max_cost is not None:
            ends["max_evaluations"] = self._left(level)
        if self.max_seconds is not None:
            passed = time.monotonic() - self.start
            ends["max_seconds"] = max(self.max_seconds - passed, 0.0)
        key = jax.random.fold_in(self.key, len(self.results))
        try:
            found = self.minimiser(level.fun, y, self.args, key=key, **self.options, **ends)
        except NoRoomError as error:
            raise ValueError(
                f"max_cost={self.max_cost} leaves no room for a step of the coarsest level: allow "
                "more"
            ) from error
        self.results.append(found)
        self.counts.append(0)
        self._paid(level, found.evaluations)
        return found

    def again(self, level: Level, y: PyTree, **ends: Any) -> Result:
        """Another search of the last level."""
        found = self.run(level, y, **ends)
        self.counts[-2:] = [sum(self.counts[-2:])]
        return found

    def _paid(self, level: Level, evaluations: int):
        """Counts evaluations of the last level."""
        self.counts[-1] += evaluations
        self.cost += evaluations * level.cost / self.unit

    def room(self, level: Level, y: PyTree, more: int = 0) -> bool:
        """Whether a step of that level can be paid for, and so many evaluations more."""
        solver, like = self.results[-1].solver, jax.tree.map(jnp.asarray, y)
        needed = solver.evaluations_per_step(like) + solver.final_evaluations(like)
        return self.max_cost is None or self._left(level) >= needed + more

    def narrower(self, share: float):
        """The next level has a smaller sigma; cost is a `share` of its."""
        found = self.results[-1]
        if self._squares():
            # residuals that are left are as far away as they are large
            share = max(share, found.fun / max(found.history[0].fun, found.fun, _TINY))
        sigma = jax.tree.map(lambda s: s * math.sqrt(share), found.solver.sigma)
        if self.options.get("solver") is None:
            # of the default solver more than sigma depends on it, and on whether there is a target
            self.options |= {"sigma": sigma}
        else:
            self.options |= {"solver": dataclasses.replace(found.solver, sigma=sigma)}

    @property
    def looks(self) -> int:
        """The evaluations that `lower` takes."""
        return 2 if self.options.get("takes_key", False) else 1

    def lower(self, level: Level, y: PyTree) -> bool:
        """Whether the function is lower at y than at what was found, by the same random numbers."""
        found = self.results[-1]
        if not self.options.get("takes_key", False):
            return self._value(level, y) < found.fun
        key = jax.random.fold_in(self.key, len(self.results))
        return self._value(level, y, key) < self._value(level, found.y, key)

    def _value(self, level: Level, y: PyTree, *key: jax.Array) -> float:
        """The function itself at a point, which is an evaluation more."""
        out = level.fun(jax.tree.map(jnp.asarray, y), self.args, *key)
        self._paid(level, 1)
        if not self._squares():
            return float(out)
        return sum(float(jnp.sum(leaf**2)) / 2 for leaf in jax.tree.leaves(out))

    def found(self, reason: str) -> CoarseToFine:
        """What there is so far, and why that is all."""
        # of a level there is no other limit
        reason = "max_cost" if reason == "max_evaluations" else reason
        return CoarseToFine(tuple(self.results), tuple(self.counts), self.cost, reason)

    def _squares(self) -> bool:
        return isinstance(self.results[-1].solver, optx.AbstractLeastSquaresSolver)

    def _left(self, level: Level) -> int:
        assert self.max_cost is not None
        return int((self.max_cost - self.cost) * self.unit / level.cost)


def _patience(level: Level, dearer: Level, y: PyTree) -> int:
    """Evaluations that cost what the next level begins with."""
    n = sum(jnp.size(leaf) for leaf in jax.tree.leaves(y))
    return int(min(max(dearer.cost / level.cost, _LEAST), _MOST) * (n + 1))
