"""Random estimates and random runs of solvers: no silent wrong number, and no hang.

FUZZ_CALLS=20000 in the environment makes so many random calls in place of 200, a part of them here.
"""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fuzzed import REFUSAL, RUNS, TRANSFORMS, outcome, says_what_to_write

import smoothdiff as sd

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::RuntimeWarning")]


# --- Transforms: units change nothing, and what cannot be known is NaN. ---


def stairs(x, a, t, unit):
    """Steps at t of heights a, along each parameter, which is in this unit."""
    return jnp.sum(jnp.asarray(jnp.where(x / unit > t, a, 0.0))) + jnp.sum(jnp.abs(x / unit - t))


def made_transform(random):
    """A transform of `stairs` at random settings, as a function of numbers alone, and its order."""
    which = random.choice(["grad", "value_and_grad", "hessian", "hvp"])
    options = {
        "num_samples": int(random.choice([16, 32, 64])),
        "sampler": random.choice([sd.Sobol(), sd.Gaussian(), sd.Gaussian(antithetic=True)]),
        "baseline": str(random.choice(["none", "mean", "linear", "gp", "auto"])),
        "nonfinite": str(random.choice(["propagate", "drop"])),
        "batch_size": random.choice([None, 8]),
    }
    make = getattr(sd, f"smooth_{which}")
    vector = (lambda x: (jnp.ones_like(x),)) if which == "hvp" else lambda x: ()
    order = {"grad": 1, "value_and_grad": 1, "hessian": 2, "hvp": 2}[which]

    @jax.jit
    def call(key, x, sigma, a, t, unit):
        g = make(stairs, sigma, **options)
        found = g(key, x, *vector(x), a, t, unit)
        return found[1] if which == "value_and_grad" else found

    return call, order, (which, options)


def test_units_change_no_estimate_and_what_is_invalid_is_nan():
    random = np.random.default_rng(2)
    each = 100  # calls of a program, which takes a second to compile
    for first in range(0, TRANSFORMS, each):
        call, order, about = made_transform(random)
        n = int(random.integers(1, 4))
        for i in range(min(each, TRANSFORMS - first)):
            key = jax.random.key(int(random.integers(2**31)))
            x, a, t = (random.normal(size=n).astype(np.float32) for _ in range(3))
            sigma = np.float32(10 ** random.uniform(-3, 2))
            unit, scale = (np.float32(2.0 ** random.integers(-20, 20)) for _ in range(2))
            where = about, i, x, sigma, unit, scale
            if random.integers(8) == 0:
                bad = random.choice([-1.0, 0.0, np.nan, np.inf]).astype(np.float32)
                lost = np.asarray(call(key, x, bad, a, t, np.float32(1)))
                assert np.all(np.isnan(lost)), (where, bad, lost)
                continue
            plain = np.asarray(call(key, x, sigma, a, t, np.float32(1)))
            other = np.asarray(call(key, x * unit, sigma * unit, a, t, unit))
            assert np.all(np.isfinite(plain)), where
            size = np.max(np.abs(plain))
            # powers of two are exact but for how sums are rounded, which fits make worse
            close = 1e-3 * size + 1e-5 * (np.sum(np.abs(a)) + sigma) / sigma**order
            assert np.all(np.abs(other * unit**order - plain) <= close), (where, plain, other)
            if order == 1:  # a step of height a along x has at most this slope, and |x| has 1
                most = np.abs(a) / (sigma * math.sqrt(2 * math.pi)) + 1
                spread = 6 * (np.sum(np.abs(a)) + n * (sigma + 3)) / sigma
                assert np.all(np.abs(plain) <= most + spread), (where, plain)


# --- Runs: what is returned was evaluated, is the lowest, within bounds and budget. ---


def valley(y):
    return 100 * (y[-1] - y[0] ** 2) ** 2 + (1 - y[0]) ** 2


def half_squares(value):
    """Of the two residuals."""
    return 1.25 * np.float64(value) ** 2 / 2


SHAPES = {
    "bowl": lambda y: np.sum(y**2),
    "kink": lambda y: np.sum(np.abs(y - 0.3)),
    "stairs": lambda y: np.sum(np.floor(8 * np.abs(y))),
    "cliff": lambda y: float(y[0] > 0.1) + 0.01 * np.sum(y),
    "valley": valley,
    "flat": lambda y: 3.0,
    "holes": lambda y: np.nan if np.sin(50 * y[0]) > 0.8 else np.sum(y**2),
    "wall": lambda y: np.inf if y[0] > 0.5 else np.sum((y - 1) ** 2),
    "huge": lambda y: 1e30 * np.sum((y - 0.5) ** 2),
    "small": lambda y: 1e-30 * np.sum((y - 0.5) ** 2),
    "far": lambda y: 1e6 + np.sum(y**2),
}


class Host:
    """The host function of all runs, so that what they share is compiled once."""

    def __init__(self, squares):
        self.squares, self.shape, self.seen = squares, "", {}

    def __call__(self, y):
        value = np.float32(SHAPES[self.shape](y.astype(np.float64)))
        self.seen.setdefault(y.tobytes(), []).append(value)
        return np.array([value, 0.5 * value], np.float32) if self.squares else value


def test_runs_return_the_lowest_point_of_those_that_they_paid_for():
    random = np.random.default_rng(3)
    hosts = [Host(squares) for squares in (False, True)]
    outs = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in ((), (2,))]
    boxes = [sd.black_box(*both, on_nonfinite="nan") for both in zip(hosts, outs, strict=True)]
    losses = [lambda y, args, box=box: box(y) for box in boxes]
    for i in range(RUNS):
        shape, squares = str(random.choice(list(SHAPES))), bool(random.integers(2))
        n, most = int(random.integers(1, 4)), int(random.integers(1, 60))
        y0 = (random.normal(size=n) * 10 ** random.uniform(-2, 2)).astype(np.float32)
        host = hosts[squares]
        host.shape, host.seen = shape, {}
        bounds = (y0 - 1, y0 + 2) if random.integers(2) else None
        sigma = None if random.integers(2) else float(10 ** random.uniform(-2, 1))
        call: Any = sd.least_squares if squares else sd.minimise
        kind: Any = sd.GaussNewton if squares else sd.NewtonCG
        solver = None if sigma is None else kind(sigma, nonfinite="drop")
        where = i, shape, squares, y0, sigma, bounds, most
        limits = {"key": jax.random.key(i), "max_evaluations": most, "bounds": bounds}
        begin = functools.partial(call, losses[squares], jnp.asarray(y0), solver=solver, **limits)
        result, error = outcome(begin)
        if error is not None:
            assert isinstance(error, REFUSAL), (where, error)
            assert says_what_to_write(str(error)) or "finite" in str(error), (where, error)
            may = shape in ("holes", "wall", "huge", "small") or "max_evaluations" in str(error)
            assert may, (where, error)
            continue
        seen = host.seen
        calls = sum(map(len, seen.values()))
        assert calls == result.evaluations <= most, (where, calls, result.evaluations)
        value = half_squares if squares else np.float64
        known = [value(v[0]) for v in seen.values() if np.isfinite(v[0])]
        y = np.asarray(result.y, np.float32)
        assert y.tobytes() in seen, where
        # squares of small numbers are zero in float32
        close = {"rtol": 1e-5, "atol": 1e-37, "err_msg": str(where)}
        np.testing.assert_allclose(result.fun, min(known), **close)
        np.testing.assert_allclose(value(seen[y.tobytes()][0]), min(known), **close)
        if bounds is not None:
            assert np.all((bounds[0] <= y) & (y <= bounds[1])), where
