"""BFGS and its relatives of the higher-order paper's appendix F, on the sampled gradient of OurG.

Plain BFGS takes whole steps. The others add one thing each: a memory of few steps (L-BFGS), a line
search for the strong Wolfe conditions, or Powell's damping, which keeps B positive definite where
noise makes y·s negative (elsewhere such a pair is left out). The paper says no more about them. As
in its other second-order methods no step is longer than a trust region of a few sigma.
"""

import collections
import itertools
import warnings
from collections.abc import Callable
from functools import partial
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import line_search

import smoothdiff as sd
from benchmarks._task import Solve, Task
from benchmarks.methods import _published as published
from benchmarks.methods._flat import Flat

RADIUS = 3.0  # of the longest step, in units of the current sigma: as OurH
MEMORY = 10  # pairs that L-BFGS keeps
DAMPING = 0.2  # the least s·y of a damped pair, in units of s·Bs
TRIALS = 5  # steps that a line search tries


class Model(Protocol):
    """What is known of the curvature."""

    def newton(self, g: np.ndarray) -> np.ndarray:
        """The step that solves B p = -g."""
        ...

    def learn(self, s: np.ndarray, y: np.ndarray) -> None:
        """Takes a step s and the change y of the gradient over it."""
        ...


class Dense:
    """The matrix B of BFGS, which starts as a multiple of the identity."""

    def __init__(self, curvature: float, size: int, damped: bool):
        self._b, self._damped = curvature * np.eye(size), damped

    def newton(self, g: np.ndarray) -> np.ndarray:
        return -np.linalg.solve(self._b, g)

    def learn(self, s: np.ndarray, y: np.ndarray) -> None:
        bs = self._b @ s
        sbs, sy = s @ bs, s @ y
        if self._damped and sy < DAMPING * sbs:
            share = (1 - DAMPING) * sbs / (sbs - sy)
            y = share * y + (1 - share) * bs
            sy = s @ y
        if sy > 1e-10 * np.linalg.norm(s) * np.linalg.norm(y):
            self._b += np.outer(y, y) / sy - np.outer(bs, bs) / sbs


class Limited:
    """L-BFGS: the last pairs alone, by the recursion of two loops."""

    def __init__(self, curvature: float):
        self._curvature, self._pairs = curvature, collections.deque(maxlen=MEMORY)

    def newton(self, g: np.ndarray) -> np.ndarray:
        q, shares = g, []
        for s, y in reversed(self._pairs):
            shares.append((s @ q) / (s @ y))
            q = q - shares[-1] * y
        q = q / self._curvature
        for (s, y), share in zip(self._pairs, reversed(shares), strict=True):
            q = q + (share - (y @ q) / (s @ y)) * s
        return -q

    def learn(self, s: np.ndarray, y: np.ndarray) -> None:
        if s @ y > 1e-10 * np.linalg.norm(s) * np.linalg.norm(y):
            self._pairs.append((s, y))
            self._curvature = (y @ y) / (s @ y)


def cut(p: np.ndarray, radius: float) -> np.ndarray:
    """The step, no longer than the radius."""
    length = float(np.linalg.norm(p))
    return p * (radius / length) if length > radius else p


def prepare(task: Task, model: Callable[[float, int], Model], wolfe: bool = False) -> Solve:
    """Compiles gradient and value; the loop and its small matrices are on the host.

    Each iteration has samples of its own; its line search sees the same ones at all its points.
    """
    flat = Flat(task)
    low, high = np.asarray(flat.low, float), np.asarray(flat.high, float)
    gradient = published.gradient(flat, aggregate=False)

    @jax.jit
    def smoothed(key, sigma, x):
        options = {"num_samples": gradient.evaluations, "sampler": sd.Gaussian(antithetic=True)}
        return sd.smooth(flat.loss, sigma, baseline="none", **options)(key, x)

    def at(estimate, key, sigma):
        return lambda x: np.asarray(estimate(key, sigma, jnp.asarray(x, flat.dtype)), float)

    def search(key, sigma, x, p, g):
        """The share of the step to take, or all of it where the search fails, and evaluations."""
        value, slope = at(smoothed, key, sigma), at(gradient.call, key, sigma)
        with warnings.catch_warnings(action="ignore"):  # a failure is expected under noise
            share, values, slopes, *_ = line_search(value, slope, x, p, g, maxiter=TRIALS)
        return 1.0 if share is None else share, (values + slopes) * gradient.evaluations

    def solve(y0, key, record):
        x, used = flat.start(y0), 0
        curvature, previous = None, None
        for i in itertools.count():
            sigma = published.sigma_at(task, flat, used)
            own = jax.random.fold_in(key, i)
            g = at(gradient.call, own, sigma)(x)
            used += gradient.evaluations
            if curvature is None and g.any():  # the first step is one sigma long
                curvature = model(float(np.linalg.norm(g)) / task.sigma, flat.size)
            if curvature is not None:
                if previous is not None:
                    curvature.learn(x - previous[0], g - previous[1])
                previous = x, g
                p = cut(curvature.newton(g), RADIUS * float(sigma))
                share, spent = search(own, sigma, x, p, g) if wolfe else (1.0, 0)
                used += spent
                x = np.clip(x + share * p, low, high)
            record(flat.tree(x))

    return solve


def _dense(curvature: float, size: int) -> Model:
    return Dense(curvature, size, damped=False)


def _damped(curvature: float, size: int) -> Model:
    return Dense(curvature, size, damped=True)


def _limited(curvature: float, size: int) -> Model:
    return Limited(curvature)


VARIANTS = {
    "bfgs": ("BFGS", partial(prepare, model=_dense)),
    "lbfgs": ("L-BFGS", partial(prepare, model=_limited)),
    "bfgs_wolfe": ("BFGS, Armijo-Wolfe line search", partial(prepare, model=_dense, wolfe=True)),
    "bfgs_damped": ("Damped BFGS", partial(prepare, model=_damped)),
}
