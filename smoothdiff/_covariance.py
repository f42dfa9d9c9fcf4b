r"""The covariance of least-squares parameters, by a regression over evaluations near the answer.

The residuals at the answer are modelled as $r + J u$ with errors that have two parts: one is the
same for all evaluations, rounding, noise or jumps, and one grows with the square of the distance,
curvature. The likelihood says how much there is of either, so that a linear function is fitted by
all evaluations and a curved one by those nearby that rounding does not spoil. What the errors add
to $J^T J$ is taken off again. A direction in which they may hide too much of it is not known.

Source: own; the variances are estimated by restricted maximum likelihood (Patterson and Thompson,
1971).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

# candidates for the distance at which both parts of the error are the same, and beyond the nearest
# and the farthest evaluation by so many powers of e
_GRID, _NEARER, _FARTHER = 24, 1, 3
# columns that are the same but for so much are not told apart
_RANK = 1e-10
# The error of J by its length, squared, in a direction that counts as known. That of curvature has
# a sign, so the root of it goes into the standard errors; that of noise is another for each
# residual, and is taken off but for its chance.
_CURVED, _NOISY = 0.01, 0.5
# a parameter is known if directions that are not known have less than this share of it, and no more
# than so many times what they have by chance, or than rounding; a variance, if they have less than
# this share of it
_SHARE, _CHANCE, _EXACT = 0.01, 16, 1e-12
# sums with a parameter may be off by so many of its roundings
_DIGITS = 8
# errors of residuals below so many of their roundings may be those of rounding, which several
# residuals share
_ROUNDINGS = 64
# residuals at a time, in float64
_CHUNK = 65536


class Slopes(NamedTuple):
    """What a regression tells of the slopes of the residuals.

    `squares` is the sum over residuals of their slopes' products, and `noise` and `curved` what the
    two parts of the errors add to it. `scale` is the unit of each parameter. `even` is the square
    of the distance at which both parts are the same, that of parameters in their units or, if
    `of_residuals`, that of residuals. The noise may be that of `rounding` alone.
    """

    squares: Float[np.ndarray, "n n"]
    noise: Float[np.ndarray, "n n"]
    curved: Float[np.ndarray, "n n"]
    scale: Float[np.ndarray, " n"]
    even: float
    of_residuals: bool
    rounding: bool


class Covariance(NamedTuple):
    """The covariance, NaN where it is not known, and the degrees of freedom of its variance."""

    matrix: Float[np.ndarray, "n n"]
    freedom: int


def slopes(
    points: Float[np.ndarray, "M n"],
    rows: Float[np.ndarray, "M P"],
    here: int | None,
) -> Slopes | None:
    """Those at the point with this index; None without it, or if there are too few points."""
    if here is None:
        return None
    away = points.astype(float) - points[here].astype(float)
    scale = np.max(np.abs(away), axis=0)
    # of a parameter that is the same in all of them nothing is known
    moved, scale = scale > 0, np.where(scale > 0, scale, 1)
    away, size = (away / scale)[:, moved], rows.shape[1]
    gram = np.zeros((len(rows), len(rows)))
    for start in range(0, size, _CHUNK):
        part = rows[:, start : start + _CHUNK].astype(float)
        part = part - part[here]
        gram += part @ part.T
    # A residual is a difference of numbers that may be much larger, and no better than their last
    # digit. How large they are, most evaluations show
    usual = np.median(np.mean(np.square(rows, dtype=float), axis=1))
    rounding = np.finfo(rows.dtype).eps ** 2 * max(usual, np.mean(rows[here].astype(float) ** 2))
    least = max(rounding, np.finfo(float).tiny)
    best, found, about = -np.inf, None, (np.inf, False, False)
    # curvature grows with the distance, by sigma or by what the residuals say
    for of_residuals, distances in ((False, np.sum(away**2, axis=1)), (True, np.diag(gram))):
        some = np.log(distances[distances > 0])
        if not len(some):
            continue
        for log in np.linspace(some.min() - _NEARER, some.max() + _FARTHER, _GRID):
            curved = (distances / np.exp(log)) ** 2
            likelihood, factor, fit = _regression(gram, away, curved, size, least)
            if likelihood > best:
                best, found = likelihood, fit
                about = np.exp(log), of_residuals, factor < _ROUNDINGS**2 * least
    if found is None:
        return None
    squares, noise, curved = (np.zeros((len(scale), len(scale))) for _ in found)
    inside = np.ix_(moved, moved)
    squares[inside], noise[inside], curved[inside] = found
    # a parameter is no better than its last digits, and so is what it changes along with others
    digits = _DIGITS * np.finfo(rows.dtype).eps * np.max(np.abs(points), axis=0) / scale
    noise += np.sum(np.diag(squares) * digits**2) * np.eye(len(scale))
    noise[~moved, ~moved] = 1
    return Slopes(squares, noise, curved, scale, *about)


def balance(known: Slopes, values: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    """How far both parts of the errors are the same: there a slope is known best.

    In directions of unit length with these sums of squared slopes.
    """
    return np.sqrt(known.even / values if known.of_residuals else np.full_like(values, known.even))


def _regression(
    gram: np.ndarray, away: np.ndarray, curved: np.ndarray, size: int, least: float
) -> tuple[float, float, tuple[np.ndarray, np.ndarray, np.ndarray] | None]:
    """The likelihood of errors of variance 1 + `curved`, but for a factor; that; what they give."""
    variance = 1 + curved
    root = 1 / np.sqrt(variance)
    design = np.concatenate([np.ones((len(away), 1)), away], axis=1) * root[:, None]
    norm = np.linalg.norm(design, axis=0)
    left, values, right = np.linalg.svd(design / norm, full_matrices=False)
    freedom = len(away) - len(values)
    if freedom < 1 or values[-1] <= _RANK * values[0]:
        return -np.inf, 1.0, None
    weighted = gram * root[:, None] * root
    rest = weighted - left @ (left.T @ weighted)
    rest = rest - (rest @ left) @ left.T
    factor = max(np.trace(rest) / (size * freedom), least)
    logs = np.sum(np.log(variance)) + 2 * np.sum(np.log(values)) + 2 * np.sum(np.log(norm))
    likelihood = -size / 2 * (freedom * np.log(factor) + logs)
    inverse = ((right.T / values @ left.T) / norm[:, None] * root)[1:]
    part = size * factor * inverse
    noise, bend = part @ inverse.T, (part * curved) @ inverse.T
    return likelihood, factor, (inverse @ gram @ inverse.T, noise, bend)


def covariance(
    known: Slopes | None, residuals: int, squares: float, fixed: Bool[np.ndarray, " n"]
) -> Covariance:
    """Of the parameters that are not fixed, for so many residuals and the sum of their squares."""
    n, free = len(fixed), np.flatnonzero(~fixed)
    matrix, freedom = np.full((n, n), np.nan), residuals - len(free)
    if known is None or freedom < 1 or not len(free):
        return Covariance(matrix, freedom)
    at = np.ix_(free, free)
    errors = known.noise[at] + known.curved[at]
    size = np.sqrt(np.diag(errors))
    # directions in which errors are independent, and as large as one
    lower = np.linalg.cholesky(errors / size / size[:, None])
    back = np.linalg.inv(lower).T / size[:, None]
    signal, turn = np.linalg.eigh(back.T @ known.squares[at] @ back)
    directions = back @ turn
    share = np.einsum("ik,ij,jk->k", directions, known.curved[at], directions)
    # rounding may be the same for all residuals, and look like a slope
    none = signal <= 1 / (_CURVED if known.rounding else _NOISY)
    alike = 1 if known.rounding else share + (1 - share) / residuals
    told = ~none & (signal > alike / _CURVED)
    part = directions[:, told]
    inner = part / (signal[told] - 1) @ part.T * (squares / freedom)
    # where there is no signal the parameters are taken as they are, where there is too little not
    parts = (directions * size[:, None]) ** 2
    moves = np.sum(parts[:, none], axis=1)
    # by chance these directions have so much of a parameter that is known
    chance = np.sum(parts[:, ~none] / signal[~none], axis=1)
    variances = directions**2 / np.maximum(signal, 1)
    adds = np.sum(variances[:, ~none & ~told], axis=1)
    most = np.minimum(_SHARE, _CHANCE * chance + _EXACT)
    unknown = (moves > most) | (adds > _SHARE * np.sum(variances[:, told], axis=1))
    inner[unknown] = inner[:, unknown] = np.nan
    unit = known.scale[free]
    matrix[at] = inner * unit * unit[:, None]
    return Covariance(matrix, freedom)
