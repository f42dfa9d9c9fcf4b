"""Errors and seconds of an estimator, from many positions; each row is kept as soon as it is done.

A row is one estimator on one problem with one number of evaluations. All estimators see the same
positions, vectors and keys.
"""

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from benchmarks._cache import cached, fingerprint
from benchmarks._timing import in_turns
from benchmarks.studies.variance.estimators import Estimator, Part
from benchmarks.studies.variance.problems import PROBLEMS, Problem

SEED = 0
RESAMPLES = 1000
TINY = 1e-9  # a width of the parameters that are not blurred


class Case(NamedTuple):
    """A problem with its positions, unit vectors, and the true derivatives there.

    `truth` has an array (repeats, ...) for each quantity; "own" is the gradient of what is blurred
    in the differentiated parameter alone.
    """

    problem: Problem
    positions: np.ndarray
    vectors: np.ndarray
    truth: dict[str, np.ndarray]


class Row(NamedTuple):
    """What one quantity of one estimator costs and errs by, for each repeat.

    `squares` are squared errors summed over the elements, `norms` the same of the truth.
    """

    evaluations: int
    squares: Float[np.ndarray, " repeats"]
    norms: Float[np.ndarray, " repeats"]
    seconds: Float[np.ndarray, " repeats"]


@lru_cache
def case(name: str, repeats: int) -> Case:
    """The problem of that name; with fewer repeats the first ones are the same."""
    problem = PROBLEMS[name]()
    keys = [jax.random.split(jax.random.fold_in(jax.random.key(SEED), i)) for i in range(repeats)]
    positions = np.stack([np.asarray(problem.position(key)) for key, _ in keys])
    vectors = np.stack([np.asarray(jax.random.normal(key, (problem.n,))) for _, key in keys])
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    return Case(problem, positions, vectors, _truth(problem, positions, vectors))


def _truth(problem: Problem, positions: np.ndarray, vectors: np.ndarray) -> dict[str, np.ndarray]:
    with jax.enable_x64(True):
        wide = jnp.full(problem.n, problem.sigma, jnp.float64)
        over = lambda fun: np.asarray(
            jax.jit(lambda ys: jax.lax.map(fun, ys))(positions.astype(np.float64))
        )
        truth = {"gradient": over(lambda y: jax.grad(problem.smoothed)(y, wide))}
        if "hessian" in problem.quantities:
            truth["hessian"] = over(lambda y: jax.hessian(problem.smoothed)(y, wide))
            truth["hvp"] = np.einsum("rij,rj->ri", truth["hessian"], vectors)

            def own(y):
                along = lambda i: jnp.where(jnp.arange(problem.n) == i, wide, TINY)
                element = lambda i: jax.grad(problem.smoothed)(y, along(i))[i]
                return jax.lax.map(element, jnp.arange(problem.n))

            truth["own"] = over(own)
        return truth


def rows(
    found: Case, estimator: Estimator, num: int, path: Path, fresh: bool = False
) -> dict[str, Row]:
    """A row for each quantity that the estimator can estimate with `num` evaluations."""
    asked = set(found.problem.quantities)
    parts = [p for p in estimator.parts(found.problem, num) if asked.issuperset(p.quantities)]
    losses = [float(found.problem.fun(y)) for y in found.positions[:2]]
    arrays = (np.round(array, 6) for array in (found.positions, *found.truth.values()))
    stored = cached(
        path,
        fingerprint(estimator, num, losses, *arrays),
        lambda: {name: row for part in parts for name, row in _measure(found, part).items()},
        fresh,
    )
    return {
        name: Row(part.evaluations, *stored[name]) for part in parts for name in part.quantities
    }


def _measure(found: Case, part: Part) -> dict[str, np.ndarray]:
    """Squares, norms and seconds of each repeat, (3, repeats), for each quantity."""
    wanted = lambda estimates: {name: estimates[name] for name in part.quantities}
    call = jax.jit(lambda *inputs: wanted(part.call(*inputs)))
    repeats = len(found.positions)
    keys = jax.random.split(jax.random.key(SEED + 1), repeats)
    inputs = list(zip(keys, found.positions, found.vectors, strict=True))
    made: list[dict[str, Any]] = []

    def run(turn: int) -> dict[str, Any]:
        made.append(call(*inputs[turn - 1]))  # the first turn, which compiles, is no repeat
        return made[-1]

    seconds = in_turns({"": run}, repeats)[""]
    out = {}
    for name in part.quantities:
        truth = found.truth["own" if part.own else name]
        away = np.stack([np.asarray(each[name], np.float64) for each in made[1:]]) - truth
        squares, norms = (np.sum(x.reshape(repeats, -1) ** 2, axis=1) for x in (away, truth))
        out[name] = np.stack([squares, norms, seconds])
    return out


def relative_rmse(row: Row) -> Float[np.ndarray, "3"]:
    """Root of the mean squared error over that of the truth, as `resampled` gives it."""
    return resampled(lambda i: _rmse(row, i), len(row.squares))


def ratio(ours: Row, theirs: Row) -> Float[np.ndarray, "3"]:
    """Their RMSE over ours on the same positions, as `resampled` gives it."""
    return resampled(lambda i: _rmse(theirs, i) / _rmse(ours, i), len(ours.squares))


def _rmse(row: Row, i: np.ndarray) -> np.ndarray:
    return np.sqrt(row.squares[i].sum(-1) / row.norms[i].sum(-1))


def resampled(statistic: Callable[[np.ndarray], Any], repeats: int) -> Float[np.ndarray, "3"]:
    """The statistic of all repeats between the ends of its 95 % bootstrap interval."""
    drawn = np.random.default_rng(SEED).integers(repeats, size=(RESAMPLES, repeats))
    low, high = np.quantile(statistic(drawn), [0.025, 0.975])
    return np.array([low, statistic(np.arange(repeats)), high])
