"""Errors and seconds of an estimator, from many positions; each row is kept as soon as it is done.

A row is one estimator on one problem with one number of evaluations. All estimators see the same
positions, vectors and keys.
"""

import hashlib
import os
import time
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from benchmarks.variance.estimators import Estimator, Part
from benchmarks.variance.problems import PROBLEMS, Problem

SEED = 0
RESAMPLES = 1000
TINY = 1e-9  # a width of the parameters that are not blurred

Arrays = dict[str, np.ndarray]


class Case(NamedTuple):
    """A problem with its positions, unit vectors, and the true derivatives there.

    `truth` has an array (repeats, ...) for each quantity; "own" is the gradient of what is blurred
    in the differentiated parameter alone.
    """

    problem: Problem
    positions: np.ndarray
    vectors: np.ndarray
    truth: Arrays

    @property
    def name(self) -> str:
        """The problem's."""
        return self.problem.name


@lru_cache
def case(name: str, repeats: int) -> Case:
    """The problem of that name; with fewer repeats the first ones are the same."""
    problem = PROBLEMS[name]()
    keys = [jax.random.split(jax.random.fold_in(jax.random.key(SEED), i)) for i in range(repeats)]
    positions = np.stack([np.asarray(problem.position(key)) for key, _ in keys])
    vectors = np.stack([np.asarray(jax.random.normal(key, (problem.n,))) for _, key in keys])
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    return Case(problem, positions, vectors, _truth(problem, positions, vectors))


def _truth(problem: Problem, positions: np.ndarray, vectors: np.ndarray) -> Arrays:
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


class Row(NamedTuple):
    """What one quantity of one estimator costs and errs by, for each repeat.

    `squares` are squared errors summed over the elements, `norms` the same of the truth.
    """

    evaluations: int
    squares: Float[np.ndarray, " repeats"]
    norms: Float[np.ndarray, " repeats"]
    seconds: Float[np.ndarray, " repeats"]


def rows(
    found: Case, name: str, estimator: Estimator, num: int, folder: Path, fresh: bool = False
) -> dict[str, Row]:
    """A row for each quantity that the estimator can estimate with `num` evaluations."""
    fingerprint = _fingerprint(found, estimator, num)
    path = folder / f"{found.name}-{name}-{num}-{len(found.positions)}.npz"
    kept = None if fresh else _load(path, fingerprint)
    if kept is None:
        kept = {}
        for part in estimator.parts(found.problem, num):
            kept |= _measure(found, part)
        _save(path, fingerprint, kept)
    quantities = {key.split(".")[0] for key in kept}
    return {
        quantity: Row(
            int(kept[f"{quantity}.evaluations"]),
            *(kept[f"{quantity}.{field}"] for field in Row._fields[1:]),
        )
        for quantity in found.problem.quantities
        if quantity in quantities
    }


def _measure(found: Case, part: Part) -> Arrays:
    call = jax.jit(part.call)
    repeats = len(found.positions)
    keys = jax.random.split(jax.random.key(SEED + 1), repeats + 1)
    jax.block_until_ready(call(keys[-1], found.positions[0], found.vectors[0]))  # compiles
    out: Arrays = {}
    for quantity in part.quantities:
        out[f"{quantity}.evaluations"] = np.asarray(part.evaluations)
        for field in Row._fields[1:]:
            out[f"{quantity}.{field}"] = np.zeros(repeats)
    for i, inputs in enumerate(zip(keys[:-1], found.positions, found.vectors, strict=True)):
        began = time.perf_counter()
        estimates = jax.block_until_ready(call(*inputs))
        seconds = time.perf_counter() - began
        for quantity in part.quantities:
            truth = found.truth["own" if part.own else quantity][i]
            error = np.asarray(estimates[quantity], np.float64) - truth
            out[f"{quantity}.squares"][i] = np.sum(error**2)
            out[f"{quantity}.norms"][i] = np.sum(truth**2)
            out[f"{quantity}.seconds"][i] = seconds
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


def _fingerprint(found: Case, estimator: Estimator, num: int) -> str:
    """Changes when the problem, its truth, the estimator or the number of evaluations does."""
    arrays = [found.positions, *found.truth.values()]
    losses = [float(found.problem.fun(y)) for y in found.positions[:2]]
    digest = hashlib.sha256(repr((estimator, num, losses)).encode())
    for array in arrays:
        digest.update(np.round(array, 6).tobytes())
    return digest.hexdigest()[:16]


def _load(path: Path, fingerprint: str) -> Arrays | None:
    if not path.exists():
        return None
    with np.load(path) as file:
        kept = dict(file)
    return kept if str(kept.pop("fingerprint")) == fingerprint else None


def _save(path: Path, fingerprint: str, arrays: Arrays) -> None:
    """Writes all or nothing, so that a kill leaves no half file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    content: dict[str, Any] = {"fingerprint": fingerprint, **arrays}
    with open(temporary, "wb") as file:
        np.savez(file, **content)
    os.replace(temporary, path)
