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
    inner_jaxprs,
    keys,
    largest,
    primitives,
    taylor,
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


def evaluations(fun, *args):
    """At how many points a call of `fun` evaluates the black box, without compiling it."""
    return _evaluations(jax.make_jaxpr(fun)(*args).jaxpr)


def _evaluations(jaxpr):
    total = 0
    for eqn in jaxpr.eqns:
        if eqn.primitive.name == "pure_callback":
            total += math.prod(eqn.invars[0].aval.shape[:-1])
        inner = sum(map(_evaluations, inner_jaxprs(eqn)))
        # how often a while loop runs is not known: what is in one must not be the black box
        assert not (inner and eqn.primitive.name == "while")
        total += inner * eqn.params.get("length", 1)
    return total


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
X = jnp.array([0.1, 0.2])


def counted(name, with_options):
    f, options = Counted(), {**PLAIN, "num_samples": 24, **COUNTED[with_options]}
    return f, TRANSFORMS[name](f, 0.5, **options), options["num_samples"]


@pytest.mark.parametrize(("name", "with_options"), PAIRINGS)
def test_a_call_evaluates_exactly_num_samples_times(name, with_options, key):
    _, g, num_samples = counted(name, with_options)
    assert evaluations(g, key, X) == num_samples


@pytest.mark.parametrize(
    ("name", "with_options"), [("smooth", "mean"), ("hvp", "chunks, center"), ("grad", "stderr")]
)
def test_evaluations_are_counted_where_they_happen(name, with_options, key):
    """What the program says, above, is what it does."""
    f, g, num_samples = counted(name, with_options)
    run = jax.jit(g)
    assert f.during(lambda: run(key, X)) == num_samples
    assert f.during(lambda: run(key, X)) == num_samples  # compiling took none


@pytest.mark.parametrize("batch_size", [None, 10])
def test_nested_ad_takes_no_further_evaluations(batch_size, key):
    f = Counted()
    g = sd.smooth(f, 0.5, **PLAIN, num_samples=24, batch_size=batch_size)
    along = lambda x: jax.jvp(lambda x: jax.grad(g, 1)(key, x), (x,), (x,))[1]
    in_sigma = lambda s: sd.smooth(f, s, **PLAIN, num_samples=24, batch_size=batch_size)(key, X)

    def linearized(x):
        _, apply = jax.linearize(lambda x: jax.grad(g, 1)(key, x), x)
        return jax.lax.map(apply, jnp.ones((10, 2)))

    derivatives = {
        "hessian": (lambda x: jax.hessian(g, 1)(key, x), X),
        "third": (lambda x: jax.jacfwd(jax.hessian(g, 1), 1)(key, x), X),
        "along": (along, X),
        "linearized": (linearized, X),
        "in sigma": (jax.hessian(in_sigma), jnp.array([0.5, 0.4])),
    }
    assert {n: evaluations(*fun_and_at) for n, fun_and_at in derivatives.items()} == dict.fromkeys(
        derivatives, 24
    )


@pytest.mark.parametrize("batch_size", [None, 10])
def test_a_quadratic_model_evaluates_once_and_for_all(batch_size, key):
    f = Counted()
    make = sd.smooth_quadratic(f, 0.5, **PLAIN, num_samples=24, batch_size=batch_size)

    def use(model):
        power = jax.lax.fori_loop(0, 100, lambda _, v: model.hessian.mv(v), model.grad)
        return model.value, power, model.stderr, model.hessian_stderr(X), model(X)

    assert evaluations(make, key, X) == 24
    assert evaluations(use, jax.eval_shape(make, key, X)) == 0
    assert evaluations(lambda x: use(make(key, x)), X) == 24
    if batch_size is None:
        run = jax.jit(lambda x: use(make(key, x)))
        assert f.during(lambda: run(X)) == 24


def test_vmap_over_keys_evaluates_for_each(key):
    f = Counted()
    g = jax.jit(jax.vmap(sd.smooth_grad(f, 0.5, **PLAIN, num_samples=24), in_axes=(0, None)))
    assert f.during(lambda: g(keys(3), jnp.zeros(2))) == 72
    assert evaluations(g, keys(3), jnp.zeros(2)) == 72


# ---------------------------------------------------------------------------------------------
# chunks

PAIRS = sd.Gaussian(antithetic=True)
# sampler, num_samples, batch_size
SIZES: dict[str, tuple[sd.AbstractSampler, int, int]] = {
    "less than a pair": (PAIRS, 24, 1),
    "pairs with a rest": (PAIRS, 26, 7),
    "weighted": (Widened(), 24, 10),
    "parts of replicates": (sd.Sobol(replicates=4), 24, 10),
    "one": (sd.Gaussian(), 24, 1),
    "all": (sd.Gaussian(), 24, 24),
    "pairs": (PAIRS, 24, 16),
}


def sizes(*quick):
    return [
        pytest.param(*case, marks=[] if name in quick else pytest.mark.slow, id=name)
        for name, case in SIZES.items()
    ]


def with_and_without_chunks(make, sampler, num_samples, batch_size):
    """What `make(options)` returns with a batch_size, and without."""
    options: dict[str, Any] = {**PLAIN, "num_samples": num_samples, "sampler": sampler}
    run = lambda batch_size: make({**options, "batch_size": batch_size})
    return jax.jit(lambda: (run(batch_size), run(None)))()


@pytest.mark.parametrize(
    ("sampler", "num_samples", "batch_size"),
    sizes("less than a pair", "pairs with a rest", "weighted"),
)
def test_chunks_change_only_the_rounding(sampler, num_samples, batch_size, key):
    """Of the value, of first and second derivatives in parameters and sigma, of aux."""

    def run(options):
        def g(at):
            out, aux = sd.smooth(lambda x: (boxes(x), x), at[2], **options, has_aux=True)(
                key, at[:2]
            )
            return {"out": out, "aux": jax.lax.stop_gradient(aux)}

        return taylor(g)(jnp.array([0.1, 0.2, 0.4]))

    assert_same(*with_and_without_chunks(run, sampler, num_samples, batch_size))


@pytest.mark.parametrize("impl", ["rbg", "unsafe_rbg"])
def test_chunks_change_only_the_rounding_for_keys_of_every_kind(impl):
    key = jax.random.key(0, impl=impl)
    run = lambda options: sd.smooth_grad(boxes, 0.4, **options)(key, X)
    for sampler in (sd.Gaussian(), sd.Sobol(replicates=4)):
        assert_same(*with_and_without_chunks(run, sampler, 16, 4))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sampler", "num_samples", "batch_size"), sizes("weighted", "parts of replicates")
)
def test_chunks_change_only_the_rounding_of_errors(sampler, num_samples, batch_size, key):
    def run(options):
        model = sd.smooth_quadratic(boxes, 0.4, **options)(key, X)
        return model.value, model.grad, model.stderr, model.hessian_stderr(jnp.array([1.0, -3.0]))

    assert_same(*with_and_without_chunks(run, sampler, num_samples, batch_size))


@pytest.mark.parametrize(
    "make",
    [
        lambda fun, **options: sd.smooth_grad(fun, 0.1, **options),
        pytest.param(
            lambda fun, **options: jax.grad(sd.smooth(fun, 0.1, **options), argnums=1),
            marks=pytest.mark.slow,
        ),
        lambda fun, **options: lambda key, x: sd.smooth_hvp(fun, 0.1, **options)(key, x, x),
    ],
    ids=["grad", "ad", "hvp"],
)
def test_memory_falls_by_the_ratio_of_the_chunks(make, key):
    """Compiled only: unchunked, the points alone are 410 MB."""
    x = jax.ShapeDtypeStruct((100_000,), jnp.float32)

    def temporary(batch_size):
        options: dict[str, Any] = {**PLAIN, "num_samples": 1024, "batch_size": batch_size}
        g = jax.jit(make(lambda x: jnp.sum(jnp.round(x)), **options))
        analysis = g.lower(key, x).compile().memory_analysis()
        assert analysis is not None
        return analysis.temp_size_in_bytes

    assert temporary(None) / temporary(64) > 0.8 * 1024 / 64


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


def test_products_in_chunks_are_compiled_once_outside_of_jit(key):
    traced = []

    def fun(x, scale):
        traced.append(1)
        return jnp.sum(jnp.abs(x)) * scale

    options = {"num_samples": 8, "baseline": "mean", "batch_size": 4}
    g = sd.smooth_hvp(fun, 0.1, **options)
    first = g(key, jnp.ones(2), jnp.ones(2), 2.0)
    count = len(traced)
    assert not jnp.array_equal(first, g(jax.random.fold_in(key, 1), jnp.ones(2), jnp.ones(2), 2.0))
    assert len(traced) == count
    whole = sd.smooth_hvp(fun, 0.1, **{**options, "batch_size": None})
    np.testing.assert_allclose(whole(key, jnp.ones(2), jnp.ones(2), 2.0), first, rtol=1e-4)
    with pytest.raises(ValueError, match="v must have the structure and shapes"):
        g(key, jnp.ones(2), jnp.ones(3), 2.0)


@pytest.mark.parametrize("dtype", [jnp.float16, jnp.bfloat16])
@pytest.mark.parametrize("num", [64, 2048])
def test_coarse_values_are_added_up_in_float32(dtype, num):
    """In float16 the sum of many values of 2000 overflows, and so it did from 64 on."""
    beside = lambda x: (2000 + 64 * x).astype(dtype)
    for baseline in ("auto", "mean", "center", "none"):
        value, grad = sd.smooth_value_and_grad(beside, 1.0, num_samples=num, baseline=baseline)(
            jax.random.key(0), 0.0
        )
        assert value == pytest.approx(2000, rel=0.02)
        assert np.isfinite(grad)
        if baseline != "none":
            assert grad == pytest.approx(64, rel=0.5)


def test_a_center_that_is_not_finite_is_dropped_too():
    hole = lambda x: jnp.where(jnp.sum(x) == 0, jnp.nan, jnp.sum(x))
    options: dict = {"num_samples": 65, "baseline": "center", "nonfinite": "drop"}
    grad = sd.smooth_grad(hole, 1.0, **options)(jax.random.key(0), jnp.zeros(2))
    assert np.all(np.isfinite(grad))


@pytest.mark.parametrize("impl", ["threefry2x32", "rbg", "unsafe_rbg"])
def test_raw_keys_are_those_of_their_kind(impl):
    """Of keys of one length those of the default kind."""
    grad, x = sd.smooth_grad(jnp.sum, 0.5), jnp.ones(2)
    with jax.default_prng_impl(impl):
        np.testing.assert_array_equal(grad(jax.random.PRNGKey(3), x), grad(jax.random.key(3), x))
    if impl != "unsafe_rbg":
        key = jax.random.key(3, impl=impl)
        np.testing.assert_array_equal(grad(jax.random.key_data(key), x), grad(key, x))


def test_argnums_may_be_numbers_of_numpy():
    product = lambda x, y: jnp.sum(x * y)
    second: Any = np.int64(1)
    grad = sd.smooth_grad(product, 0.5, argnums=second)(jax.random.key(0), 2.0, jnp.ones(2))
    assert jnp.shape(grad) == (2,)


def test_whole_numbers_are_no_parameters():
    x = {"a": jnp.ones(2), "n": 3}
    fun = lambda x: jnp.sum(x["a"]) * x["n"]
    for sigma in (0.1, {"a": 0.1, "n": None}):
        with pytest.raises(TypeError, match="another argument of the function"):
            sd.smooth_grad(fun, sigma)(jax.random.key(0), x)
    assert sd.smooth(fun, {"a": 0.1, "n": None})(jax.random.key(0), x) == pytest.approx(6, rel=0.1)
