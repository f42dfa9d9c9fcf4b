"""Random values of host functions and random arguments: what is not exact or wrong is an error.

FUZZ_CALLS=20000 in the environment makes so many random calls in place of 200, a part of them here.
"""

import inspect
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from closed_forms import as_users_have_it
from fuzzed import CASTS, REFUSAL, REFUSALS, outcome, says_what_to_write

import smoothdiff as sd

KEY = jax.random.key(0)

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::RuntimeWarning")]


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
        near = [info.min, info.max, 0, 1, -1, 127, 128, 255, 256]
        near += [2**24 + 1, 2**31, 2**32, 2**53 + 1]
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
