"""The last judgement: of all that a run has seen, what it returns."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from smoothdiff._seen import Seen
from smoothdiff._solvers._base import Progress
from smoothdiff._solvers._evaluator import Evaluator
from smoothdiff._solvers._random_numbers import in_round, takes_key
from smoothdiff._solvers._where import where

# how often each candidate is evaluated where the function is noisy
_REPEATS = 3
# so many standard errors lower is clearly lower
_CLEARLY = 3.0
# what rounding may do to a value that another program computes again, in units of its own
ROUNDING = 64
# of JAX or of NumPy
Number = Float[Array | np.ndarray, ""] | np.floating


class Values(NamedTuple):
    """The function `at` stacked points, with the numbers of a round if it takes a key."""

    at: Callable[[PyTree[Array], Int[Array, ""]], Float[Array, " m"]]
    takes_key: bool


class Contest(eqx.Module):
    """The candidates for an answer, stacked, of which `each` are evaluated in a round.

    First come those that were never evaluated, then the lowest point of the run, then others.
    """

    progress: Progress
    points: PyTree[Array]
    each: int = eqx.field(static=True)
    takes_key: bool = eqx.field(static=True)

    @staticmethod
    def of(
        progress: Progress,
        takes_key: bool,
        new: Sequence[PyTree[Array]],
        old: Sequence[PyTree[Array]],
    ) -> "Contest":
        """Between these and the lowest point; all are new where numbers are fresh."""
        if takes_key:
            new, old = [*new, *old], []
        candidates = *new, progress.lowest_y, *old
        points = jax.tree.map(lambda *leaves: jnp.stack(leaves), *candidates)
        return Contest(progress, points, 1 + len(new), takes_key)

    def unknown(self) -> Float[np.ndarray, " m"]:
        """The values of all rounds before any is known: NaN."""
        return np.full(self._rounds() * self.each, np.nan, self.progress.lowest_fun.dtype)

    def round(self, done: int | Int[Array, ""]) -> Int[Array | np.ndarray, " each"]:
        """Which points come next after so many rounds."""
        at = np.arange(self.each, dtype=np.int32)
        return (self.each * done + at) % len(jax.tree.leaves(self.points)[0])

    def goes_on(
        self, done: int | Int[Array, ""], found: Float[Array | np.ndarray, " m"]
    ) -> Bool[Array | np.ndarray, ""] | np.bool:
        """Whether another round is needed after these."""
        again = self.takes_key | differ(found[self.each - 1], self.progress.lowest_fun)
        return (done == 0) | ((done < self._rounds()) & again)

    def decided(
        self,
        done: Int[Array, ""],
        found: Float[Array, " m"],
        estimate: Callable[[PyTree[Array]], tuple[Array, Array, Seen]],
        batch: int,
    ) -> tuple[PyTree[Array], dict[str, Array]]:
        """The best point and the statistics of the run after so many rounds."""
        if self.takes_key:
            y, fun, differs = _clear_winner(found, self.points)
        else:
            y, fun, differs = _winner(found, self.points, self.progress, self.each - 1)
        smoothed, stderr, seen = estimate(y)
        last = seen.value.astype(found.dtype)
        lower = ~differs & (last < fun)
        y, fun = where(lower, (seen.point, last), (y, fun))
        evaluations = self.progress.evaluations + self.each * done + batch
        return y, {"fun": fun, "smoothed": smoothed, "stderr": stderr, "evaluations": evaluations}

    def _rounds(self) -> int:
        return _rounds(len(jax.tree.leaves(self.points)[0]), self.each)


def judged(
    progress: Progress,
    values: Values,
    estimate: Callable[[PyTree[Array]], tuple[Array, Array, Seen]],
    batch: int,
    new: Sequence[PyTree[Array]],
    old: Sequence[PyTree[Array]] = (),
) -> tuple[PyTree[Array], dict[str, Array]]:
    """The best point and the statistics of the run.

    The lowest point that was evaluated is evaluated again, together with the `new` candidates. If
    its value is the same, the function has no noise, and the lowest of these points is the answer.
    If not, its value was luck: then all candidates, the `old` ones too, are evaluated until there
    are three values of each, and the lowest mean is the answer.

    A function that takes a key is evaluated at all candidates in three rounds, each with fresh
    numbers that all of them share. The first of the `new` ones is the answer, unless another one is
    clearly lower.

    A last batch around the answer gives the smoothed function there. Without noise, a point of that
    batch which is lower still takes the answer's place.

    Args:
        progress: Of the run.
        values: The function itself.
        estimate: y -> the smoothed function, its standard error, the lowest of the fresh batch
            behind them.
        batch: The evaluations that `estimate` makes.
        new: Candidates that were never evaluated.
        old: Candidates that were, so that without noise none of them is lower than the lowest.

    Returns:
        The point, and the statistics: `fun`, the function there; `smoothed` and `stderr`, from the
        last batch; and the `evaluations` of the run. A candidate at which the function is not
        finite loses; the lowest point keeps the value that it had, if others are finite. Of equals
        the first of the `new` ones wins, as on a plateau an iterate is further from the edges than
        a sample. A start that is the lowest point wins over equals.
    """
    return evaluated(Contest.of(progress, values.takes_key, new, old), values, estimate, batch)


def evaluated(
    contest: Contest,
    values: Values,
    estimate: Callable[[PyTree[Array]], tuple[Array, Array, Seen]],
    batch: int = 0,
) -> tuple[PyTree[Array], dict[str, Array]]:
    """The same between the points of a contest."""

    # one loop, so that the function is compiled once, and every value of a point by one program
    def one_round(state: tuple[Array, Array]) -> tuple[Array, Array]:
        done, found = state
        at = contest.round(done)
        fresh = values.at(jax.tree.map(lambda a: a[at], contest.points), done).astype(found.dtype)
        found = jax.lax.dynamic_update_slice(found, fresh, (contest.each * done,))
        return done + 1, found

    none = jnp.asarray(0, jnp.int32), jnp.asarray(contest.unknown())
    done, found = jax.lax.while_loop(lambda state: contest.goes_on(*state), one_round, none)
    return contest.decided(done, found, estimate, batch)


@partial(jax.jit, static_argnums=3)
def _winner(
    found: Float[Array, " m"], points: PyTree[Array], progress: Progress, lowest: int
) -> tuple[PyTree[Array], Array, Array]:
    """The point with the lowest mean of all its values, that mean, and whether values differ.

    One of the points is the lowest of the run.
    """
    count = len(jax.tree.leaves(points)[0])
    # where it failed again and again, and others did not, its first value is all that is known
    failed = ~jnp.any(jnp.isfinite(found[lowest::count])) & jnp.any(jnp.isfinite(found))
    found = found.at[lowest].set(jnp.where(failed, progress.lowest_fun, found[lowest]))
    table = found[: _REPEATS * count].reshape(_REPEATS, count)
    finite = jnp.isfinite(table)
    least = jnp.min(jnp.where(finite, table, jnp.inf), axis=0)
    above = jnp.where(finite, table - least[None], 0)
    # so that the mean of equal values is that value, to the last bit
    times = jnp.maximum(jnp.sum(finite, axis=0), 1).astype(found.dtype)
    means = least + jnp.sum(above, axis=0) / times
    winner = jnp.argmin(means)
    # where nothing was lower than the start, what is as low is no better
    stays = progress.at_start() & (means[lowest] <= means[winner])
    winner = jnp.where(stays, lowest, winner)
    return jax.tree.map(lambda a: a[winner], points), means[winner], jnp.any(above > 0)


@jax.jit
def _clear_winner(
    found: Float[Array, " m"], points: PyTree[Array]
) -> tuple[PyTree[Array], Array, Array]:
    """The first point, unless by the same random numbers another one is clearly lower.

    Also its mean, and whether it differs from round to round.
    """
    table = found.reshape(_REPEATS, -1)
    finite = jnp.all(jnp.isfinite(table), axis=0)
    away = jnp.where(finite[None], table - table[:, :1], 0)
    error = jnp.std(away, axis=0, ddof=1) / math.sqrt(_REPEATS)
    lower = finite & (~finite[0] | (jnp.mean(away, axis=0) < -_CLEARLY * error))
    means = jnp.mean(table, axis=0)
    winner = jnp.where(jnp.any(lower), jnp.argmin(jnp.where(lower, means, jnp.inf)), 0)
    differs = jnp.any(table[:, winner] != table[0, winner])
    return jax.tree.map(lambda a: a[winner], points), means[winner], differs


def judging(batch: int, new: int, old: int = 0) -> int:
    """The most evaluations that `judged` makes for so many candidates."""
    return _rounds(1 + new + old, 1 + new) * (1 + new) + batch


def one_by_one(fn: Callable, args: Any, options: dict[str, Any], batch_size: int | None) -> Values:
    """The function at stacked points, at most so many of them at a time."""

    def at(points: PyTree[Array], number: Int[Array, ""]) -> Array:
        size, seen = batch_size or len(jax.tree.leaves(points)[0]), in_round(args, options, number)
        return jax.lax.map(lambda y: fn(y, seen)[0], points, batch_size=size)

    return Values(at, takes_key(options))


def by_rows(evaluate: Evaluator, options: dict[str, Any]) -> Values:
    """The same where the function returns rows."""

    def at(points: PyTree[Array], number: Int[Array, ""]) -> Array:
        args = in_round(evaluate.args, options, number)
        return dataclasses.replace(evaluate, args=args).values(points)

    return Values(at, takes_key(options))


def _rounds(count: int, each: int) -> int:
    """How often so many are evaluated until there are enough values of all."""
    return -(-_REPEATS * count // each)


def differ(again: Number, before: Number) -> Bool[Array | np.ndarray, ""] | np.bool:
    """Whether a value that was computed twice differs by more than rounding."""
    eps = ROUNDING * jnp.finfo(before.dtype).eps
    # by operators, for NumPy's numbers as well
    return (abs(before) < math.inf) & ~(abs(again - before) <= eps * abs(before))
