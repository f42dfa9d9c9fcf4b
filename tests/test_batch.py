"""How often the function is called, in how much memory, and what features that are off cost."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import (
    PLAIN,
    Widened,
    assert_same,
    boxes,
    keys,
    largest,
    primitives,
)

import smoothdiff as sd


class Counted:
    """A black box of NumPy that counts the points at which it is evaluated."""

    def __init__(self):
        self.count = 0

    def __call__(self, x):
        def host(x):
            x = np.asarray(x)
            self.count += math.prod(x.shape[:-1])
            return np.round(x).sum(axis=-1).astype(x.dtype)

        out = jax.ShapeDtypeStruct((), x.dtype)
        return jax.pure_callback(host, out, x, vmap_method="expand_dims")

    def during(self, call):
        before = self.count
        jax.block_until_ready(call())
        return self.count - before


# ---------------------------------------------------------------------------------------------
# counts

TRANSFORMS = {
    "smooth": sd.smooth,
    "grad": sd.smooth_grad,
    "value_and_grad": sd.smooth_value_and_grad,
    "jacobian": sd.smooth_jacobian,
    "hessian": sd.smooth_hessian,
    "hvp": lambda *a, **k: lambda key, x: sd.smooth_hvp(*a, **k)(key, x, x),
}
COUNTED = {
    "mean": {},
    "center": {"num_samples": 25, "baseline": "center"},
    "chunks": {"batch_size": 10},
    "chunks, center": {"num_samples": 25, "batch_size": 8, "baseline": "center"},
    "stderr": {"stderr": True},
    "stderr, chunks": {"batch_size": 10, "stderr": True},
    "drop, bounds": {"nonfinite": "drop", "bounds": (-9.0, 9.0)},
}


# every transform as it is, and the most involved one with every option
PAIRINGS = [(name, options) for name in TRANSFORMS for options in ("mean", "stderr, chunks")]
PAIRINGS += [("hvp", options) for options in COUNTED if ("hvp", options) not in PAIRINGS]


@pytest.mark.parametrize(("name", "with_options"), PAIRINGS)
def test_a_call_evaluates_exactly_num_samples_times(name, with_options, key):
    f, options = Counted(), {**PLAIN, "num_samples": 24, **COUNTED[with_options]}
    g = jax.jit(TRANSFORMS[name](f, 0.5, **options))
    x = jnp.array([0.1, 0.2])
    assert f.during(lambda: g(key, x)) == options["num_samples"]
    assert f.during(lambda: g(key, x)) == options["num_samples"]  # compiling took none


@pytest.mark.parametrize("batch_size", [None, 10])
def test_nested_ad_takes_no_further_evaluations(batch_size, key):
    f = Counted()
    g = sd.smooth(f, 0.5, **PLAIN, num_samples=24, batch_size=batch_size)
    x = jnp.array([0.1, 0.2])
    along = lambda x: jax.jvp(lambda x: jax.grad(g, 1)(key, x), (x,), (x,))[1]
    in_sigma = lambda s: sd.smooth(f, s, **PLAIN, num_samples=24, batch_size=batch_size)(key, x)

    def linearized(x):
        _, apply = jax.linearize(lambda x: jax.grad(g, 1)(key, x), x)
        return jax.lax.map(apply, jnp.ones((10, 2)))

    for derived, at in (
        (lambda x: jax.hessian(g, 1)(key, x), x),
        (lambda x: jax.jacfwd(jax.hessian(g, 1), 1)(key, x), x),
        (along, x),
        (linearized, x),
        (jax.hessian(in_sigma), jnp.array([0.5, 0.4])),
    ):
        run = jax.jit(derived)
        assert f.during(lambda run=run, at=at: run(at)) == 24


@pytest.mark.parametrize("batch_size", [None, 10])
def test_a_quadratic_model_evaluates_once_and_for_all(batch_size, key):
    f = Counted()
    make = jax.jit(sd.smooth_quadratic(f, 0.5, **PLAIN, num_samples=24, batch_size=batch_size))
    x = jnp.array([0.1, 0.2])
    assert f.during(lambda: make(key, x)) == 24
    model = make(key, x)
    apply = jax.jit(lambda model, v: model.hessian.mv(v))

    def many():
        v = x
        for _ in range(100):
            v = apply(model, v)
        return v, jax.jit(lambda m: (m.stderr, m.hessian_stderr(x), m(x)))(model)

    assert f.during(many) == 0

    @jax.jit
    def together(x):
        model = make(key, x)
        power = jax.lax.fori_loop(0, 100, lambda _, v: model.hessian.mv(v), model.grad)
        return model.value, power, model.stderr, model.hessian_stderr(x), model(x)

    assert f.during(lambda: together(x)) == 24


def test_vmap_over_keys_evaluates_for_each(key):
    f = Counted()
    g = jax.jit(jax.vmap(sd.smooth_grad(f, 0.5, **PLAIN, num_samples=24), in_axes=(0, None)))
    assert f.during(lambda: g(keys(3), jnp.zeros(2))) == 72


# ---------------------------------------------------------------------------------------------
# chunks


SIZES = [
    (sd.Gaussian(), 1),
    (sd.Gaussian(), 24),
    (sd.Gaussian(antithetic=True), 1),
    (sd.Gaussian(antithetic=True), 7),
    (sd.Gaussian(antithetic=True), 16),
    (Widened(), 10),
]


@pytest.mark.parametrize(("sampler", "batch_size"), SIZES)
def test_chunks_change_only_the_rounding(sampler, batch_size, key):
    x, v = jnp.array([0.1, 0.2]), jnp.array([1.0, -3.0])
    fun = lambda x: (boxes(x), x)

    def run(batch_size):
        options: dict[str, Any] = {
            **PLAIN,
            "num_samples": 24,
            "sampler": sampler,
            "batch_size": batch_size,
        }
        return (
            sd.smooth_grad(fun, 0.4, **options, has_aux=True)(key, x),
            jax.grad(lambda s: sd.smooth(boxes, s, **options)(key, x))(jnp.array(0.4)),
            sd.smooth_value_and_grad(boxes, 0.4, **options, stderr=True)(key, x),
            sd.smooth_hvp(boxes, 0.4, **options, stderr=True)(key, x, v),
        )

    found, want = jax.jit(lambda: (run(batch_size), run(None)))()
    assert_same(found, want)


def test_memory_falls_by_the_ratio_of_the_chunks(key):
    """Compiled only: unchunked, the points alone are 410 MB."""
    x = jax.ShapeDtypeStruct((100_000,), jnp.float32)
    fun = lambda x: jnp.sum(jnp.round(x))

    def temporary(make, batch_size):
        options: dict[str, Any] = {**PLAIN, "num_samples": 1024, "batch_size": batch_size}
        analysis = jax.jit(make(options)).lower(key, x).compile().memory_analysis()
        assert analysis is not None
        return analysis.temp_size_in_bytes

    for make in (
        lambda options: sd.smooth_grad(fun, 0.1, **options),
        lambda options: jax.grad(sd.smooth(fun, 0.1, **options), argnums=1),
        lambda options: lambda key, x: sd.smooth_hvp(fun, 0.1, **options)(key, x, x),
    ):
        ratio = temporary(make, None) / temporary(make, 64)
        assert ratio > 0.8 * 1024 / 64


# ---------------------------------------------------------------------------------------------
# what is off costs nothing


def test_features_that_are_off_leave_no_equation(key):
    x = jnp.zeros(2)

    def names(transform=sd.smooth_grad, sigma=0.5, **options):
        return primitives(transform(boxes, sigma, **{**PLAIN, **options}), key, x)

    plain = names()
    assert "is_finite" not in plain
    assert "is_finite" in names(nonfinite="drop")
    assert "clamp" not in plain
    assert len(names(bounds=(-1.0, 1.0))) > len(plain)
    remat = {"checkpoint", "remat2"}
    assert not remat & set(plain)
    assert remat & set(names(batch_size=8))
    assert len(names(stderr=True)) > len(plain)
    assert len(names(baseline="none")) < len(plain)
    traced = primitives(lambda s: sd.smooth_grad(boxes, s, **PLAIN)(key, x), 0.5)
    assert traced.count("log") == plain.count("log") + 1  # of the ratio of the two sigmas


def test_a_leaf_with_sigma_none_is_not_sampled(key):
    p = {"few": jnp.zeros(3), "many": jnp.zeros(100_000)}
    fun = lambda p: jnp.round(jnp.sum(p["few"])) + p["many"][0]
    g = sd.smooth_grad(fun, {"few": 0.5, "many": None}, **PLAIN, num_samples=64)
    assert largest(g, key, p) == 100_000
    assert largest(sd.smooth_grad(fun, 0.5, **PLAIN, num_samples=64), key, p) >= 64 * 100_000


def test_no_hessian_sized_array_unless_asked_for(key):
    x = jnp.zeros(1000)
    fun = lambda x: jnp.round(jnp.sum(x))
    options: dict[str, Any] = {**PLAIN, "num_samples": 16}

    def model(key, x):
        model = sd.smooth_quadratic(fun, 0.5, **options)(key, x)
        return model.hessian.mv(x), model.hessian_stderr(x)

    assert largest(sd.smooth_grad(fun, 0.5, **options), key, x) <= 32 * 1000
    assert largest(sd.smooth_hvp(fun, 0.5, **options), key, x, x) <= 32 * 1000
    assert largest(model, key, x) <= 32 * 1000
