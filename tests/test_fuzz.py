"""Random calls: no silent wrong number, no hang, and an error that says what to write.

FUZZ_CALLS=20000 in the environment makes so many calls in place of 200.
"""

import inspect
import math
import os
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from closed_forms import as_users_have_it

import smoothdiff as sd

CALLS = int(os.environ.get("FUZZ_CALLS", 200))
KEY = jax.random.key(0)
# a call of a made-up solver run is dear, a cast or a refusal is cheap
CASTS, REFUSALS, TRANSFORMS, RUNS = (round(CALLS * share) for share in (0.5, 0.3, 0.175, 0.025))

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::RuntimeWarning")]


REFUSAL = TypeError, ValueError, sd.BlackBoxError, sd.MinimiseError


def outcome(call) -> tuple[Any, Any]:
    """What it returns, or what it raises."""
    try:
        return call(), None
    except Exception as error:
        return None, error


# --- Casts: what a host function returns is what arrives, or an error names it. ---

TYPES = ("bool", "int8", "uint8", "int32", "uint32", "int64", "uint64", "float16", "float32")
TYPES += ("float64", "complex64")
# what a jit without 64 bits can promise
PROMISED = ("bool", "int8", "uint8", "int32", "uint32", "float16", "bfloat16", "float32")


def returned(random):
    """A number or a small array of any type, often at its limits."""
    dtype = np.dtype(random.choice(TYPES))
    shape = () if random.integers(3) else (3,)
    if dtype.kind in "iu":
        info = np.iinfo(dtype)
        near = [
            info.min,
            info.max,
            0,
            1,
            -1,
            127,
            128,
            255,
            256,
            2**24 + 1,
            2**31,
            2**32,
            2**53 + 1,
        ]
        fits = [number for number in near if info.min <= number <= info.max]
        value = np.array(random.choice(np.array(fits, object), shape), dtype)
    elif dtype.kind == "b":
        value = np.array(random.integers(2, size=shape), dtype)
    else:
        near = [0.0, -0.0, 0.5, 1.0, 300.0, 1e5, 1e30, 1e300, 1e-40, np.inf, np.nan, 2**24 + 1]
        with np.errstate(over="ignore"):
            value = random.choice(near, shape) * random.choice([1, -1])
            value = np.asarray(value).astype(dtype)
    how = random.integers(8)
    if how == 0 and value.ndim:
        return np.ma.masked_array(value, random.integers(2, size=3).astype(bool))
    return value.item() if how == 1 and not value.ndim else value


def test_what_a_host_function_returns_arrives_or_is_refused():
    random = np.random.default_rng(0)
    given: list[Any] = [None]
    boxes = {}
    for shape in ((), (3,)):
        for name in PROMISED:
            box = sd.black_box(lambda x: given[0], jax.ShapeDtypeStruct(shape, name))
            boxes[shape, name] = jax.jit(box)
    refused = 0
    for _ in range(CASTS):
        given[0] = value = returned(random)
        name, shape = random.choice(PROMISED), random.choice([0, 1])
        shape = np.shape(value) if random.integers(10) else ((), (3,))[shape]
        came, error = outcome(lambda name=name, shape=shape: boxes[tuple(shape), str(name)](1.0))
        if error is not None:
            refused += 1
            assert re.search("black box.*(instead of|does not fit|not finite|mask)", str(error))
            continue
        came = np.asarray(came)
        assert not np.ma.is_masked(value)
        exact = np.asarray(value)
        assert came.shape == exact.shape
        if came.dtype.kind in "biu":
            want = [int(number) for number in exact.ravel().tolist()]
            assert [int(number) for number in came.ravel().tolist()] == want, (value, name)
        else:
            assert np.all(np.isfinite(came.astype(np.float64)))
            wide = exact.astype(np.float64)
            spacing = float(jnp.finfo(came.dtype).eps)
            # XLA's threads take subnormal numbers for zero
            small = float(jnp.finfo(came.dtype).tiny)
            error = np.abs(came.astype(np.float64) - wide)
            assert np.all(error <= spacing * np.abs(wide) + small), (value, name, came)
    assert 0.1 * CASTS < refused < 0.9 * CASTS


# --- Refusals: an argument of any kind works, or the error names it. ---

JUNK = {
    "None": None,
    "True": True,
    "zero": 0,
    "minus one": -1,
    "half": 0.5,
    "huge": 10**12,
    "NaN": np.nan,
    "infinity": np.inf,
    "complex": 1j,
    "string": "lots",
    "empty string": "",
    "empty list": [],
    "empty dict": {},
    "a pair": (0.0, 1.0),
    "a pair the wrong way": (1.0, -1.0),
    "array": np.array([0.1, 0.2, 0.3]),
    "integers": np.array([1, 2]),
    "no number": np.zeros(0),
    "object": object(),
    "function": lambda *args: 0.5,
    "class": sd.Sobol,
    "sampler": sd.Gaussian(),
    "solver": sd.NewtonCG(0.1),
    "optax": optax.adam(0.1),
    "key": jax.random.key(3),
    "keys": jax.random.split(jax.random.key(3)),
}
# a path may be anything, and so may what is true or not
NOT_ASKED = {"fun", "checkpoint", "callback", "store", "progress", "args", "y0"}
NOT_ASKED |= {"has_aux", "stderr", "takes_key", "batched", "residuals"}


def bowl(y, args=None):
    return jnp.sum(jnp.abs(y - 0.3))


def parts_of(y, args=None):
    return y - 0.3


X = jnp.array([0.1, 0.2])
HOST = {"max_evaluations": 3}


def transform(make):
    return lambda **given: make(bowl, **{"sigma": 0.5, "num_samples": 8, **given})(KEY, X)


def run(call, fun, make=None):
    def called(**given):
        if make is None:
            return call(fun, X, **{"key": KEY, **HOST, **given}).fun
        return call(fun, X, key=KEY, solver=make(**{"sigma": 0.5, **given}), **HOST).fun

    return called


SOLVERS = {
    "NewtonCG": (sd.NewtonCG, run(sd.minimise, bowl, sd.NewtonCG)),
    "GaussNewton": (sd.GaussNewton, run(sd.least_squares, parts_of, sd.GaussNewton)),
    "ZeroGrads": (sd.ZeroGrads, run(sd.minimise, bowl, sd.ZeroGrads)),
}
CALLED = {
    "smooth_grad": (sd.smooth_grad, transform(as_users_have_it(sd.smooth_grad))),
    "smooth_hessian": (sd.smooth_hessian, transform(as_users_have_it(sd.smooth_hessian))),
    "minimise": (sd.minimise, run(as_users_have_it(sd.minimise), bowl)),
    "least_squares": (sd.least_squares, run(as_users_have_it(sd.least_squares), parts_of)),
    "Search": (
        sd.Search,
        lambda **given: as_users_have_it(sd.Search)(X, **{"key": KEY, **given}).ask(1),
    ),
    "black_box": (
        sd.black_box,
        lambda **given: as_users_have_it(sd.black_box)(lambda x: np.abs(x).sum(), **given)(X),
    ),
    **SOLVERS,
}
ASKED = [
    (name, argument)
    for name, (call, _) in CALLED.items()
    for argument in inspect.signature(call).parameters
    if argument not in NOT_ASKED
]


def test_an_argument_of_any_kind_works_or_the_error_names_it():
    random = np.random.default_rng(1)
    every = [(where, junk) for where in ASKED for junk in JUNK]
    # all of them as often as calls are left for, and the rest at random
    chosen = [every[i] for _ in range(REFUSALS // len(every)) for i in range(len(every))]
    rest = random.choice(len(every), REFUSALS % len(every), replace=False)
    for (name, argument), junk in chosen + [every[i] for i in rest]:
        where = f"{name}({argument}={junk})"
        value, error = outcome(lambda n=name, a=argument, j=junk: CALLED[n][1](**{a: JUNK[j]}))
        if error is not None:
            assert isinstance(error, REFUSAL), (where, error)
            assert argument in str(error).lower() or says_what_to_write(str(error)), (where, error)
        for leaf in jax.tree.leaves(value):
            assert np.all(np.isfinite(leaf)), (where, value)


def says_what_to_write(message):
    return any(
        word in message.lower() for word in ("write ", "give ", "allow ", "must ", "use ", "needs ")
    )


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


def test_runs_return_the_lowest_point_of_those_that_they_paid_for():
    random = np.random.default_rng(3)
    for i in range(RUNS):
        shape, squares = str(random.choice(list(SHAPES))), bool(random.integers(2))
        n, most = int(random.integers(1, 4)), int(random.integers(1, 60))
        y0 = (random.normal(size=n) * 10 ** random.uniform(-2, 2)).astype(np.float32)
        seen = {}

        def host(y, shape=shape, squares=squares, seen=seen):
            value = np.float32(SHAPES[shape](y.astype(np.float64)))
            seen.setdefault(y.tobytes(), []).append(value)
            return np.array([value, 0.5 * value], np.float32) if squares else value

        out = jax.ShapeDtypeStruct((2,) if squares else (), jnp.float32)
        box = sd.black_box(host, out, on_nonfinite="nan")
        bounds = (y0 - 1, y0 + 2) if random.integers(2) else None
        sigma = None if random.integers(2) else float(10 ** random.uniform(-2, 1))
        call: Any = sd.least_squares if squares else sd.minimise
        kind: Any = sd.GaussNewton if squares else sd.NewtonCG
        solver = None if sigma is None else kind(sigma, nonfinite="drop")
        where = i, shape, squares, y0, sigma, bounds, most
        loss = lambda y, args, box=box: box(y)
        limits = {"key": jax.random.key(i), "max_evaluations": most, "bounds": bounds}
        result, error = outcome(
            lambda call=call, loss=loss, y0=y0, solver=solver, limits=limits: call(
                loss, jnp.asarray(y0), solver=solver, **limits
            )
        )
        if error is not None:
            assert isinstance(error, REFUSAL), (where, error)
            assert says_what_to_write(str(error)) or "finite" in str(error), (where, error)
            may = shape in ("holes", "wall", "huge") or "max_evaluations" in str(error)
            assert may, (where, error)
            continue
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
