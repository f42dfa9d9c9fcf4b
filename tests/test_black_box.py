"""Host functions as JAX functions: how often they are called, with what, what their faults say."""

import concurrent.futures
import logging
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from awaited import awaited
from closed_forms import as_users_have_it

import smoothdiff as sd
from smoothdiff._black_box import black_box
from smoothdiff._host_samples import BlackBoxError, wait_for
from smoothdiff._reraise import reraise

SCALAR = jax.ShapeDtypeStruct((), jnp.float32)


class Counted:
    """A host function that counts its calls and the samples in them."""

    __name__ = "counted"

    def __init__(self, fun, batched=False):
        self.fun, self.batched, self.calls, self.samples = fun, batched, 0, 0

    def __call__(self, *args):
        assert all(type(leaf) is np.ndarray for leaf in jax.tree.leaves(args))
        self.calls += 1
        self.samples += len(args[0]) if self.batched else 1
        return self.fun(*args)


def stairs(x):
    return np.floor(x).sum(axis=-1)


def stairs_box(batched=False, **options):
    """The same NumPy code serves a single sample and a batch: the parameters are the last axis."""
    counted = Counted(stairs, batched)
    return black_box(counted, SCALAR, batched=batched, **options), counted


def over_while(f, xs):
    def body(carry):
        i, ys = carry
        return i + 1, ys.at[i].set(f(xs[i]))

    return jax.lax.while_loop(lambda c: c[0] < len(xs), body, (0, jnp.zeros(len(xs))))[1]


WAYS = {
    "vmap": (lambda f, xs: jax.vmap(f)(xs), 1),
    "vmap of vmap": (lambda f, xs: jax.vmap(jax.vmap(f))(xs.reshape(2, 3, 2)).ravel(), 1),
    "vmap of jit": (lambda f, xs: jax.vmap(jax.jit(f))(xs), 1),
    "map": (lambda f, xs: jax.lax.map(f, xs), 6),
    "map in chunks": (lambda f, xs: jax.lax.map(f, xs, batch_size=3), 2),
    "scan": (lambda f, xs: jax.lax.scan(lambda c, x: (c, f(x)), None, xs)[1], 6),
    "while_loop": (over_while, 6),
    "checkpoint": (lambda f, xs: jax.vmap(jax.checkpoint(f))(xs), 1),
}


@pytest.mark.parametrize("jit", [False, True])
@pytest.mark.parametrize("batched", [False, True])
@pytest.mark.parametrize("way", WAYS)
def test_each_sample_is_evaluated_once_under_every_transform(way, batched, jit):
    box, counted = stairs_box(batched)
    mapper, batches = WAYS[way]
    xs = jnp.linspace(-3.3, 4.1, 12).reshape(6, 2)
    f = lambda xs: mapper(box, xs)
    ys = (jax.jit(f) if jit else f)(xs)
    np.testing.assert_array_equal(ys, stairs(np.asarray(xs)))
    assert ys.dtype == jnp.float32
    assert counted.samples == 6
    assert counted.calls == (batches if batched else 6)


def test_outside_of_vmap_a_batch_has_size_one():
    shapes = []
    box = black_box(
        lambda x, y: shapes.append((x.shape, y.shape)) or x + y[:, 0], 0.0, batched=True
    )
    assert box(1.0, jnp.array([2.0, 5.0])) == 3.0
    assert shapes == [((1,), (1, 2))]


@pytest.mark.parametrize("batched", [False, True])
def test_unbatched_arguments_and_nested_vmap(batched):
    """Every argument is batched over other axes; one callback sees all of them broadcast."""
    seen = []

    def host(a, b, c, d):
        seen.append((a.shape, b.shape, c.shape, d.shape))
        return a + 10 * b + 100 * c + d.sum(axis=-1)

    box = black_box(host, SCALAR, batched=batched)
    a, b = jnp.arange(2.0), jnp.arange(3.0)
    over_b = jax.vmap(box, in_axes=(None, 0, None, None))
    got = jax.jit(jax.vmap(over_b, in_axes=(0, None, None, None)))(a, b, 2.0, jnp.ones(4))
    np.testing.assert_array_equal(got, a[:, None] + 10 * b[None, :] + 204.0)
    each = ((6,), (6,), (6,), (6, 4)) if batched else ((), (), (), (4,))
    assert seen == [each] * (1 if batched else 6)


def test_unbatched_arguments_of_a_batch_are_not_copied():
    strides = []
    box = black_box(lambda x, image: strides.append(image.strides[0]) or x, SCALAR, batched=True)
    jax.vmap(box, in_axes=(0, None))(jnp.arange(5.0), jnp.ones((64, 64)))
    assert strides == [0]


@pytest.mark.parametrize("batched", [False, True])
def test_empty_batch(batched):
    box, _ = stairs_box(batched)
    assert jax.jit(jax.vmap(box))(jnp.zeros((0, 2))).shape == (0,)


def test_no_arguments():
    assert jax.jit(black_box(lambda: 3.0, 0.0))() == 3.0


def test_calls_outside_of_jit_compile_once(caplog):
    box, counted = stairs_box()
    jax.clear_caches()
    box(jnp.full(2, 0.5))
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        for i in range(3):
            box(jnp.full(2, float(i)))
    assert counted.calls == 4
    assert not [r for r in caplog.records if "pure_callback" in r.getMessage()]


def test_name_and_docstring_are_those_of_the_host_function():
    def render(x):
        """Renders."""
        return x

    box = black_box(render, SCALAR)
    assert (box.__name__, box.__doc__) == ("render", "Renders.")


# --- automatic differentiation ---------------------------------------------------------------


def estimate(box, mapper, zs):
    """The score-weighted mean over stopped points: all derivatives without one of the box."""

    def mean(theta):
        stopped = jax.lax.stop_gradient(theta)
        sample = lambda z: jnp.exp(z @ (theta - stopped)) * box(stopped + z)
        return mapper(sample, zs).mean()

    return mean


DERIVATIVES = {
    "grad": jax.grad,
    "hessian": jax.hessian,
    "jvp": lambda f: lambda x: jax.jvp(f, (x,), (jnp.ones_like(x),)),
    "hvp": lambda f: lambda x: jax.jvp(jax.grad(f), (x,), (jnp.ones_like(x),)),
    "linearize": lambda f: lambda x: jax.linearize(f, x)[1](jnp.ones_like(x)),
    "third": lambda f: jax.jacfwd(jax.hessian(f)),
}


@pytest.mark.parametrize(
    ("derivative", "way", "jit"),
    [(derivative, "vmap", True) for derivative in DERIVATIVES]
    + [("hessian", way, True) for way in ("vmap of vmap", "map in chunks", "scan", "checkpoint")]
    + [("grad", "vmap", False), ("hvp", "scan", False)],
)
def test_derivatives_around_the_box_evaluate_it_once_a_sample(derivative, way, jit):
    mapper, _ = WAYS[way]
    zs = jnp.linspace(-1.7, 1.9, 12).reshape(6, 2)
    theta = jnp.array([0.3, -0.6])
    floor = lambda x: jax.lax.stop_gradient(jnp.floor(x).sum())
    want = jax.jit(DERIVATIVES[derivative](estimate(floor, mapper, zs)))(theta)
    box, counted = stairs_box()
    f = DERIVATIVES[derivative](estimate(box, mapper, zs))
    got = (jax.jit(f) if jit else f)(theta)
    jax.tree.map(lambda g, w: np.testing.assert_allclose(g, w, rtol=1e-5, atol=1e-5), got, want)
    assert counted.samples == 6


def test_derivatives_batched_over_parameters_and_through_while_loop():
    zs = jnp.linspace(-1.7, 1.9, 12).reshape(6, 2)
    thetas = jnp.array([[0.3, -0.6], [1.2, 0.1], [-2.0, 0.5]])
    box, counted = stairs_box(batched=True)
    grad = jax.grad(estimate(box, WAYS["vmap"][0], zs))
    many = jax.jit(jax.vmap(grad))(thetas)
    assert (counted.calls, counted.samples) == (1, 18)
    np.testing.assert_allclose(many, [grad(theta) for theta in thetas], rtol=1e-6)
    ascended = jax.jit(lambda x: jax.lax.fori_loop(0, 2, lambda _, x: x + 0.1 * grad(x), x))
    x = thetas[0] + 0.1 * grad(thetas[0])
    np.testing.assert_allclose(ascended(thetas[0]), x + 0.1 * grad(x), rtol=1e-5)


@pytest.mark.parametrize("jit", [False, True])
@pytest.mark.parametrize("derivative", [jax.grad, jax.hessian, DERIVATIVES["jvp"]])
def test_differentiating_the_box_itself_says_what_to_do(derivative, jit):
    box, counted = stairs_box()
    f = derivative(lambda x: jnp.sin(box(jnp.stack([x, x]))))
    with pytest.raises(TypeError, match=r"black box 'counted' has no derivative.*sd\.smooth"):
        (jax.jit(f) if jit else f)(0.5)
    assert counted.calls == 0


# --- what goes in and what comes out -----------------------------------------------------------


@pytest.mark.parametrize("batched", [False, True])
def test_pytrees_in_and_out(batched):
    def host(scene, spp):
        assert set(scene) == {"ball", "lights"}
        image = scene["ball"][..., None, None] * np.ones((2, 3)) * spp[..., None, None]
        return {"image": image, "aux": (scene["lights"][1] + 1, scene["lights"][0] > 0)}

    out = {
        "image": jax.ShapeDtypeStruct((2, 3), jnp.float32),
        "aux": (np.array([0, 0]), True),
    }
    box = black_box(host, out, batched=batched)
    scene = {"ball": jnp.arange(4.0), "lights": [jnp.float32(1.0), jnp.arange(8).reshape(4, 2)]}
    in_axes = ({"ball": 0, "lights": [None, 0]}, None)
    got = jax.jit(jax.vmap(box, in_axes=in_axes))(scene, 2)
    np.testing.assert_array_equal(got["image"], 2 * np.arange(4.0)[:, None, None] * np.ones((2, 3)))
    np.testing.assert_array_equal(got["aux"][0], np.arange(8).reshape(4, 2) + 1)
    assert got["aux"][1].tolist() == [True] * 4
    assert jax.tree.map(lambda a: a.dtype.name, got) == {
        "image": "float32",
        "aux": ("int32", "bool"),
    }


@pytest.mark.parametrize("example", [0.0, np.zeros(()), jnp.zeros(())])
def test_out_as_an_example(example):
    assert black_box(lambda x: x + 1, example)(1.0).dtype == jnp.float32


def test_types_follow_x64_when_called(x64):
    with jax.enable_x64(False):
        box = black_box(lambda x: x / 3, np.zeros(2))
        single = box(jnp.ones(2))
    double = box(jnp.ones(2))
    assert (single.dtype, double.dtype) == (jnp.float32, jnp.float64)
    np.testing.assert_array_equal(double, np.ones(2) / 3)
    assert jax.jit(jax.vmap(box))(jnp.ones((3, 2))).dtype == jnp.float64


def test_float64_that_is_on_in_another_thread_alone_is_an_error(x64, monkeypatch):
    def elsewhere(callback, shapes, *leaves, vmap_method):
        with jax.enable_x64(False):  # as in a thread of JAX's
            return callback(*leaves)

    monkeypatch.setattr(jax, "pure_callback", elsewhere)
    box = black_box(lambda x: x / 3, np.zeros(2))
    with pytest.raises(BlackBoxError, match=r'update\("jax_enable_x64", True\) instead'):
        box(jnp.ones(2))


@pytest.mark.parametrize(
    ("returned", "expected"),
    [
        (np.float64(0.1), np.float32(0.1)),  # narrowed
        (np.array(0.5, np.float16), np.float32(0.5)),
        (jnp.bfloat16(0.5), np.float32(0.5)),
        (2, np.float32(2)),  # a plain Python number has no type of its own
        (True, np.float32(1)),
        (jnp.bfloat16(1.5), jnp.bfloat16(1.5)),
        (0.1, jnp.bfloat16(0.1)),
        (np.int64(7), np.int32(7)),
        (np.float32(0.5), np.complex64(0.5)),
        (0.5, np.complex64(0.5)),
        (np.float64(1 / 3), np.float16(1 / 3)),
        (np.uint8(100), np.int8(100)),
        (np.uint64(2**31 - 1), np.int32(2**31 - 1)),
        (np.array(True), np.int32(1)),
        (np.ma.masked_array(0.5, mask=False), np.float32(0.5)),
    ],
)
def test_results_are_cast_to_the_precision_asked_for(returned, expected):
    got = black_box(lambda: returned, expected)()
    assert got.dtype == expected.dtype
    assert got == expected


def test_lists_where_an_array_is_promised():
    got = black_box(lambda: [1.0, 2.0], jax.ShapeDtypeStruct((2,), jnp.float32))()
    np.testing.assert_array_equal(got, [1.0, 2.0])


@pytest.mark.parametrize(
    ("returned", "out", "message"),
    [
        (np.zeros(3), np.zeros(2), r"shape \(3,\) instead of \(2,\)"),
        (np.zeros((1, 2)), np.zeros(2), r"shape \(1, 2\) instead of \(2,\)"),
        (np.zeros(2), 0.0, r"shape \(2,\) instead of \(\)"),
        (np.zeros(2, int), np.zeros(2), "dtype int64 instead of float32"),
        (np.array(True), 0.0, "dtype bool instead of float32"),
        (1j, 0.0, "dtype complex128 instead of float32"),
        (np.complex64(1), 0.0, "dtype complex64 instead of float32"),
        (0.5, 0, "dtype float64 instead of int32"),
        (1 + 0j, jnp.bfloat16(0), r"dtype complex128 instead of bfloat16: \(1\+0j\)"),
        (0.5, np.array(True), "dtype float64 instead of bool: 0.5"),
        (np.array([1, 2]), np.array([True, False]), r"dtype int64 instead of bool: \[1 2\]"),
        (3_000_000_000, 0, "3000000000 does not fit into int32.*wider type in `out`"),
        (np.array([1, 3_000_000_000]), np.zeros(2, np.int32), "3000000000 does not fit into int32"),
        (np.uint8(200), np.int8(0), "200 does not fit into int8"),
        (-1, np.uint8(0), "-1 does not fit into uint8"),
        (np.uint64(2**63), 0, "9223372036854775808 does not fit into int32"),
        (np.array(9), jnp.int4(0), "9 does not fit into int4"),
        (10**40, 0.0, "dtype object instead of float32: 10000000000"),
        (
            np.ma.masked_array([1.0, 2.0], mask=[False, True]),
            np.zeros(2),
            r"masked array \[1.0 --\], whose mask would be lost in float32.*value.filled\(0\)",
        ),
        (np.ma.masked, 0.0, "the masked array --"),
        (None, 0.0, "dtype object instead of float32"),
        ("red", 0.0, "dtype <U3 instead of float32"),
        ([[1.0], [1.0, 2.0]], np.zeros(2), "inhomogeneous"),
        (0.0, (0.0, 0.0), "does not return what `out` promises"),
        ({"a": 0.0}, {"b": 0.0}, "does not return what `out` promises"),
    ],
)
def test_a_result_that_does_not_match_always_raises(returned, out, message):
    calls = []
    floats = all(isinstance(leaf, float) for leaf in jax.tree.leaves(out))
    on_error = "nan" if floats else "raise"
    box = black_box(lambda x: calls.append(x) or returned, out, on_error=on_error, retries=2)
    with pytest.raises(BlackBoxError, match=message) as info:
        box(0.25)
    assert "<lambda>" in str(info.value)
    assert "array(0.25, dtype=float32)" in str(info.value)
    assert len(calls) == 1


def test_a_batch_of_the_wrong_length_raises():
    box = black_box(lambda x: x[:1], SCALAR, batched=True)
    with pytest.raises(BlackBoxError, match=r"batch of 4: .*shape \(1,\) instead of \(4,\)"):
        awaited(jax.vmap(box), jnp.arange(4.0))


def test_on_a_cpu_the_call_itself_raises():
    """Not only who waits for it, and not JAX's own error."""
    box = black_box(lambda x: x[:1], SCALAR, batched=True)
    with jax.default_device(jax.devices("cpu")[0]), pytest.raises(BlackBoxError, match="batch of"):
        jax.vmap(box)(jnp.arange(4.0))


def test_arguments_are_read_only():
    def host(x):
        x[0] = 1.0
        return 0.0

    with pytest.raises(BlackBoxError, match="read-only"):
        black_box(host, 0.0)(jnp.zeros(2))


@pytest.fixture
def threads():
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        yield pool


# --- found by the first call --------------------------------------------------------------------


def found_stairs(batched=False, **options):
    counted = Counted(stairs, batched)
    return black_box(counted, batched=batched, **options), counted


@pytest.mark.parametrize("threaded", [False, True])
@pytest.mark.parametrize("batched", [False, True])
def test_the_first_call_finds_what_is_returned_and_is_a_call_as_any(batched, threaded, threads):
    options = {"executor": threads} if threaded and not batched else {}
    box, counted = found_stairs(batched, **options)
    x, xs = jnp.array([1.5, 2.5]), jnp.linspace(-3.3, 4.1, 12).reshape(6, 2)
    first = box(x)
    assert (first, first.dtype, first.shape, counted.samples) == (3.0, jnp.float32, (), 1)
    np.testing.assert_array_equal(jax.jit(jax.vmap(box))(xs), stairs(np.asarray(xs)))
    assert box(x) == 3.0
    assert counted.samples == 8


def test_decorators():
    @black_box
    def plain(x):
        """Doubles."""
        return 2 * x

    @black_box(batched=True, on_nonfinite="nan")
    def of_a_batch(x):
        return np.where(x[:, 0] > 0, x[:, 0], np.nan)

    @black_box(out=SCALAR)
    def promised(x):
        return x.sum()

    x = jnp.array([1.0, 3.0])
    assert (plain.__name__, plain.__doc__) == ("plain", "Doubles.")
    np.testing.assert_array_equal(plain(x), 2 * x)
    assert of_a_batch(x) == 1.0
    assert np.isnan(jax.jit(of_a_batch)(-x))
    assert jax.jit(promised)(x) == 4.0


def test_pytrees_are_found():
    box = black_box(lambda s: {"image": np.ones((2, 3)) * s["a"], "counts": [np.arange(2), True]})
    s = {"a": jnp.float32(2.0)}
    first = box(s)
    assert jax.tree.map(lambda a: (a.dtype.name, a.shape), first) == {
        "image": ("float32", (2, 3)),  # float64 without x64, and int64 likewise
        "counts": [("int32", (2,)), ("bool", ())],
    }
    jax.tree.map(np.testing.assert_array_equal, jax.jit(box)(s), first)


def test_arguments_of_other_shapes_and_types_are_found_anew(x64):
    box, counted = found_stairs()
    with jax.enable_x64(False):
        assert box(jnp.ones(2)).dtype == jnp.float32
    assert box(jnp.ones(2)).dtype == jnp.float64
    assert box(jnp.ones((3, 2))).shape == (3,)
    assert counted.calls == 3
    assert jax.eval_shape(box, jnp.ones((3, 2))).shape == (3,)
    with pytest.raises(TypeError, match=r"float64\[4, 2\]"):
        jax.eval_shape(box, jnp.ones((4, 2)))
    assert counted.calls == 3


@pytest.mark.parametrize(
    "transform",
    [
        jax.jit,
        jax.grad,
        lambda f: lambda x: jax.vmap(f)(x[None]),
        lambda f: lambda x: sd.smooth_grad(f, 0.5)(jax.random.key(0), x),
    ],
)
def test_what_is_not_found_yet_cannot_be_traced(transform):
    box, counted = found_stairs()
    message = (
        r"'counted' returns for \(float32\[2\]\).*call it once before.*"
        r"sd\.black_box\(counted, out=jax\.ShapeDtypeStruct"
    )
    with pytest.raises(TypeError, match=message):
        transform(box)(jnp.ones(2))
    assert counted.calls == 0


def test_after_the_first_call_it_can_be_smoothed_within_the_evaluations(key):
    box, counted = found_stairs()
    x = jnp.array([0.2, 1.7])
    box(x)
    assert sd.smooth_grad(box, 0.5, num_samples=8)(key, x).shape == (2,)
    assert counted.samples == 9


def test_a_first_call_that_fails_raises_and_finds_nothing():
    host = Flaky(2)
    box = black_box(host, on_error="nan", retries=0)
    for i in range(2):
        with pytest.raises(BlackBoxError, match=f"licence server, try {i + 1}") as info:
            box(1.0)
        assert isinstance(info.value.__cause__, OSError)
    assert box(1.0) == 1.0
    assert black_box(Flaky(2), retries=2)(1.0) == 1.0
    assert np.isnan(black_box(lambda x: x * np.nan, on_nonfinite="nan")(1.0))
    with pytest.raises(BlackBoxError, match="not finite"):
        black_box(lambda x: x - np.inf)(1.0)


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (None, "cannot be what the first call returned, None: `out` has no arrays"),
        ("red", "first call returned, 'red'.*one of its leaves is"),
        ([[1.0], {}, object()], "one of its leaves is"),
        (3_000_000_000, "3000000000 does not fit into int32"),
        (np.ma.masked_array([1.0, 2.0], mask=[False, True]), "mask would be lost"),
    ],
)
def test_a_first_result_that_cannot_be(returned, message):
    with pytest.raises(BlackBoxError, match=message):
        black_box(lambda x: returned)(0.25)


def test_a_first_batch_without_its_axis():
    with pytest.raises(BlackBoxError, match=r"shape \(\) for a batch of one.*must begin with"):
        black_box(lambda x: x.sum(), batched=True)(jnp.ones(3))


def test_later_results_must_be_like_the_first():
    box = black_box(lambda x: 0 if x < 1 else 0.5)
    assert box(0.0).dtype == jnp.int32
    with pytest.raises(BlackBoxError, match="returned at first: dtype float64 instead of int32"):
        box(1.0)
    with pytest.raises(ValueError, match="integers have no NaN"):
        black_box(lambda x: 1, on_error="nan")(0.0)


# --- faults --------------------------------------------------------------------------------------


def fragile(x):
    """Fails where its parameter is negative."""
    if x.min() < 0:
        raise ValueError(f"negative roughness {x.min():.2f}")
    return np.sqrt(x).sum()


XS = jnp.array([[1.0, 4.0], [9.0, -1.0], [16.0, 25.0], [-4.0, 1.0]])


def test_an_exception_is_raised_as_itself_outside_of_jit():
    with pytest.raises(BlackBoxError) as info:
        black_box(fragile, 0.0)(XS[1])
    assert isinstance(info.value.__cause__, ValueError)
    assert str(info.value).startswith(
        "black box 'fragile': raised ValueError: negative roughness -1.00\n"
        "  fragile(array([ 9., -1.], dtype=float32))\n"
    )


@pytest.mark.parametrize("transform", [jax.vmap, lambda f: lambda xs: jax.lax.map(f, xs)])
def test_message_under_jit_names_function_parameters_error_and_traceback(transform):
    with pytest.raises(jax.errors.JaxRuntimeError) as info:
        jax.block_until_ready(jax.jit(transform(black_box(fragile, 0.0)))(XS))
    for part in (
        "black box 'fragile'",
        "fragile(array([ 9., -1.], dtype=float32))",
        "ValueError: negative roughness -1.00",
        "Traceback",
        'raise ValueError(f"negative roughness',
        "in fragile",
    ):
        assert part in str(info.value)
    assert ("sample 1 of 4" in str(info.value)) == (transform is jax.vmap)


def test_large_arguments_are_abbreviated():
    def host(tree):
        raise ValueError("no")

    with pytest.raises(BlackBoxError) as info:
        black_box(host, 0.0)({f"texture{i}": jnp.zeros((64, 64)) for i in range(200)})
    assert "host({'texture0': array([[0., 0., 0., ..., 0., 0., 0.]" in str(info.value)
    assert len(str(info.value)) < 4000


def test_reraise_gives_the_original_as_the_cause():
    f = jax.jit(jax.vmap(black_box(fragile, 0.0)))
    for _ in range(2):  # JAX raises another type of error from the second call on
        with pytest.raises(BlackBoxError, match="negative roughness") as info:
            awaited(f, XS)
        assert type(info.value.__cause__) is ValueError
        assert info.value.__cause__.__traceback__ is not None
        np.testing.assert_array_equal(awaited(f, abs(XS)), [3.0, 4.0, 9.0, 3.0])


def test_reraise_leaves_other_errors_alone_and_keeps_nothing():
    from smoothdiff import _reraise

    def bad(x):
        raise ValueError("not ours")

    foreign = jax.jit(lambda x: jax.pure_callback(bad, SCALAR, x))

    def ours_then_foreign():
        with pytest.raises(BlackBoxError):
            black_box(fragile, 0.0)(XS[1])
        return jax.block_until_ready(foreign(0.0))

    with pytest.raises(jax.errors.JaxRuntimeError, match="not ours"), reraise():
        ours_then_foreign()
    with pytest.raises(ValueError, match="of the user's"), reraise():
        raise ValueError("of the user's")
    assert not _reraise._open_blocks


def test_reraise_in_threads_gives_each_its_own():
    f = jax.jit(black_box(fragile, 0.0))
    barrier = threading.Barrier(4)

    def run(i):
        barrier.wait()
        with pytest.raises(BlackBoxError) as info:
            awaited(f, [1.0, -1.0 - i])
        return str(info.value.__cause__)

    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        assert list(pool.map(run, range(4))) == [
            f"negative roughness {-1.0 - i:.2f}" for i in range(4)
        ]


@pytest.fixture
def listens_to_ctrl_c():
    """A shell that starts the tests in the background tells them to ignore Ctrl-C."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def interrupted(x):
    signal.raise_signal(signal.SIGINT)
    return x


def raises_interrupt(x):
    raise KeyboardInterrupt


@pytest.mark.usefixtures("listens_to_ctrl_c")
@pytest.mark.parametrize("host", [interrupted, raises_interrupt])
@pytest.mark.parametrize("on_error", ["raise", "nan"])
def test_keyboard_interrupt_arrives_as_itself(host, on_error):
    box = black_box(host, 0.0, on_error=on_error, retries=3)
    with pytest.raises(KeyboardInterrupt):
        box(1.0)
    f = jax.jit(jax.vmap(box))
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            awaited(f, np.ones(3))


@pytest.mark.usefixtures("listens_to_ctrl_c")
def test_keyboard_interrupt_while_an_executor_works():
    """Ctrl-C goes to the main thread, which waits for the worker."""
    with concurrent.futures.ThreadPoolExecutor(1) as pool, pytest.raises(KeyboardInterrupt):
        black_box(interrupted, 0.0, executor=pool, on_error="nan")(1.0)


def test_in_a_run_jax_logs_nothing_beside_the_error(caplog):
    def stuck(y):
        raise ValueError("the solver is stuck")

    box = sd.black_box(stuck, out=0.0)
    with pytest.raises(sd.MinimiseError, match="the solver is stuck"):
        sd.minimise(lambda y, args: box(y), jnp.ones(2), key=jax.random.key(0))
    assert not caplog.records


def test_nan_on_error_in_every_output_of_the_sample(caplog):
    box = black_box(lambda x: (fragile(x), x), (0.0, np.zeros(2)), on_error="nan")
    with caplog.at_level(logging.INFO, "smoothdiff"):
        total, same = jax.jit(jax.vmap(box))(XS)
    np.testing.assert_array_equal(total, [3.0, np.nan, 9.0, np.nan])
    np.testing.assert_array_equal(same[::2], XS[::2])
    assert np.isnan(same[1::2]).all()
    assert "negative roughness -4.00" in caplog.text


def test_nan_on_error_of_a_batch_is_the_whole_batch():
    def host(x):
        raise ValueError("all lost")

    got = jax.vmap(black_box(host, 0.0, batched=True, on_error="nan"))(jnp.ones(3))
    assert np.isnan(got).all()
    with pytest.raises(BlackBoxError, match=r"'host', batch of 3: raised ValueError: all lost"):
        awaited(jax.vmap(black_box(host, 0.0, batched=True)), jnp.ones(3))


@pytest.mark.parametrize("batched", [False, True])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])
def test_nonfinite_results(bad, batched):
    """1e300 is finite for NumPy, and infinite in the float32 that was asked for."""
    host = lambda x, y: (np.where(x == 2, np.float64(bad), x), np.stack([y, y], axis=-1))
    out = (0.0, np.zeros(2))
    xs, ys = jnp.arange(4.0), jnp.ones(4)
    with pytest.raises(BlackBoxError, match=r"sample 2 of 4: .*not finite") as info:
        awaited(jax.vmap(black_box(host, out, batched=batched)), xs, ys)
    assert "<lambda>(array(2., dtype=float32), array(1., dtype=float32))" in str(info.value)
    box = black_box(host, out, batched=batched, on_nonfinite="nan")
    first, second = jax.jit(jax.vmap(box))(xs, ys)
    np.testing.assert_array_equal(first, [0.0, 1.0, np.nan, 3.0])
    np.testing.assert_array_equal(np.isnan(second).any(axis=1), [False, False, True, False])


def test_on_error_and_on_nonfinite_are_apart():
    box = black_box(lambda x: x / 0 if x < 0 else fragile(x), 0.0, on_error="nan")
    with pytest.raises(BlackBoxError, match="not finite"), np.errstate(divide="ignore"):
        black_box(lambda x: x / np.zeros(()), 0.0, on_error="nan")(1.0)
    with np.errstate(divide="raise"):
        assert np.isnan(box(-1.0))


# --- retries, timeouts and executors -----------------------------------------------------------


class Flaky:
    """Fails the first `failures` times that it sees a sample."""

    __name__ = "flaky"

    def __init__(self, failures):
        self.failures, self.seen = failures, {}

    def __call__(self, x):
        tries = self.seen[float(x)] = self.seen.get(float(x), 0) + 1
        if tries <= self.failures:
            raise OSError(f"licence server, try {tries}")
        return x


@pytest.mark.parametrize("threaded", [False, True])
def test_retries(threaded, threads):
    executor = threads if threaded else None
    host = Flaky(2)
    box = black_box(host, 0.0, retries=2, executor=executor)
    np.testing.assert_array_equal(jax.jit(jax.vmap(box))(jnp.arange(3.0)), [0.0, 1.0, 2.0])
    assert host.seen == {0.0: 3, 1.0: 3, 2.0: 3}

    box = black_box(Flaky(2), 0.0, retries=1, executor=executor)
    with pytest.raises(BlackBoxError, match=r"try 2 \(tried 2 times\)") as info:
        box(1.0)
    assert isinstance(info.value.__cause__, OSError)

    host = Flaky(9)
    assert np.isnan(black_box(host, 0.0, retries=1, on_error="nan", executor=executor)(1.0))
    assert host.seen == {1.0: 2}


def test_retry_of_a_batch():
    calls = []

    def host(x):
        calls.append(x)
        if len(calls) == 1:
            raise OSError("once")
        return x

    box = black_box(host, 0.0, batched=True, retries=1)
    np.testing.assert_array_equal(jax.vmap(box)(jnp.arange(3.0)), [0.0, 1.0, 2.0])
    assert len(calls) == 2


def test_threads_run_at_once_and_keep_the_order(threads):
    meet = threading.Barrier(2)  # passes only if two calls are under way together

    def host(x):
        meet.wait(timeout=20)
        time.sleep(0.02 * float(x < 2))
        return x**2

    f = jax.jit(jax.vmap(jax.vmap(black_box(host, 0.0, executor=threads))))
    xs = jnp.arange(6.0).reshape(2, 3)
    np.testing.assert_array_equal(f(xs), xs**2)


def test_the_first_failure_cancels_what_has_not_begun():
    seen = []

    def host(x):
        seen.append(float(x))
        time.sleep(0.02 if x else 0)
        raise ValueError("first")

    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        gate = threading.Event()
        pool.submit(gate.wait)  # holds the only worker until everything is in the queue
        threading.Timer(0.2, gate.set).start()
        with pytest.raises(BlackBoxError, match="sample 0 of 50"):
            awaited(jax.vmap(black_box(host, 0.0, executor=pool)), jnp.arange(50.0))
    assert len(seen) < 50
    box, counted = black_box(host, 0.0), len(seen)
    with pytest.raises(BlackBoxError, match="sample 0 of 50"):
        awaited(jax.vmap(box), jnp.arange(50.0))
    assert len(seen) == counted + 1


def test_timeout(threads):
    release = threading.Event()

    def host(x):
        if x == 1:
            release.wait(20)
        return x

    box = black_box(host, 0.0, executor=threads, timeout=0.5)
    with pytest.raises(BlackBoxError, match=r"TimeoutError: no result within 0\.5 s") as info:
        awaited(jax.vmap(box), jnp.arange(4.0))
    assert isinstance(info.value.__cause__, TimeoutError)
    box = black_box(host, 0.0, executor=threads, timeout=0.5, on_error="nan", retries=1)
    release.set()
    np.testing.assert_array_equal(jax.vmap(box)(jnp.arange(4.0)), jnp.arange(4.0))
    release.clear()
    # One call and its second try are stuck, each in a worker: the others must come before.
    xs = jnp.array([0.0, 2.0, 3.0, 1.0])
    np.testing.assert_array_equal(jax.vmap(box)(xs), [0.0, 2.0, 3.0, np.nan])
    release.set()


def test_timeout_does_not_count_the_wait_for_a_worker():
    host = lambda x: time.sleep(0.1) or x
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        box = black_box(host, 0.0, executor=pool, timeout=1.0)
        np.testing.assert_array_equal(jax.vmap(box)(jnp.arange(14.0)), jnp.arange(14.0))


def test_a_timeout_error_of_the_function_is_its_own(threads):
    def host(x):
        raise TimeoutError("the licence server is silent")

    with pytest.raises(BlackBoxError, match="the licence server is silent"):
        black_box(host, 0.0, executor=threads, timeout=5)(0.0)


def test_an_executor_that_was_shut_down():
    pool = concurrent.futures.ThreadPoolExecutor(1)
    pool.shutdown()
    box = black_box(fragile, 0.0, executor=pool, on_error="nan")
    with pytest.raises(BlackBoxError, match=r"'fragile': the executor takes no more calls.*shut"):
        box(jnp.ones(2))


def in_worker(x):
    """Runs in another process: says which, fails, or kills it."""
    if x == 2:
        raise ValueError(f"bad sample {x:.0f}")
    if x == 3:
        os._exit(1)
    return x, np.array(os.getpid())


def test_processes():
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(1, mp_context=context) as pool:
        f = jax.jit(jax.vmap(black_box(in_worker, (0.0, 0), executor=pool)))
        xs, pids = f(jnp.array([0.0, 1.0]))
        np.testing.assert_array_equal(xs, [0.0, 1.0])
        assert pids[0] == pids[1] != os.getpid()
        with pytest.raises(BlackBoxError, match="sample 1 of 2: raised ValueError") as info:
            awaited(f, [0.0, 2.0])
        assert "in in_worker" in str(info.value)  # the traceback of the other process
        with pytest.raises(BlackBoxError, match="BrokenProcessPool") as info:
            awaited(f, [3.0])
        assert "a worker crashes" in str(info.value)
        with pytest.raises(BlackBoxError, match="make a new one"):
            awaited(f, [0.0])


# --- misuse --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"on_error": "ignore"}, ValueError, 'on_error must be "raise" or "nan"'),
        ({"on_nonfinite": "drop"}, ValueError, 'on_nonfinite must be "raise" or "nan"'),
        ({"out": (0.0, 1), "on_error": "nan"}, ValueError, "integers have no NaN"),
        ({"out": True, "on_nonfinite": "nan"}, ValueError, "integers have no NaN"),
        ({"retries": -1}, ValueError, "retries must be 0"),
        ({"timeout": 1.0}, ValueError, r"timeout needs an executor.*sd\.Processes"),
        ({"executor": True, "timeout": 0}, ValueError, "timeout must be a positive"),
        ({"executor": True, "timeout": np.nan}, ValueError, "timeout must be a positive"),
        ({"executor": True, "batched": True}, ValueError, "batched=False"),
        ({"out": ()}, TypeError, "jax.ShapeDtypeStruct"),
        ({"out": "float32"}, TypeError, "one of its leaves is"),
        ({"out": np.float32}, TypeError, "one of its leaves is"),
        ({"executor": concurrent.futures.ThreadPoolExecutor}, TypeError, "executor"),
    ],
)
def test_misuse_says_what_to_write(options, error, message, threads):
    options = {"out": 0.0} | options
    if options.get("executor") is True:
        options["executor"] = threads
    with pytest.raises(error, match=message):
        black_box(fragile, **options)


def test_a_function_is_needed():
    make = as_users_have_it(black_box)
    with pytest.raises(TypeError, match=r"needs a function.*not 3\.0"):
        make(3.0, 0.0)
    with pytest.raises(TypeError, match=r"what it returns is out=\.\.\."):
        make(SCALAR)(fragile)


def test_typed_keys_are_refused(key):
    with pytest.raises(TypeError, match=r"jax\.random\.key_data"):
        jax.jit(black_box(lambda k: 0.0, 0.0))(key)
    assert black_box(lambda k: float(k.sum()), 0.0)(jax.random.key_data(jax.random.key(3))) == 3


class Slow:
    """An argument that JAX has not copied yet."""

    def __init__(self, looks):
        self.looks = looks

    def is_ready(self):
        self.looks -= 1
        return self.looks < 0


def test_arguments_that_never_arrive_raise_instead_of_hanging(monkeypatch):
    wait_for([np.ones(3), Slow(3)], "stairs", seconds=60.0)
    with pytest.raises(BlackBoxError, match=r"stairs: .* NPROC=2"):
        wait_for([np.ones(3), Slow(10**9)], "stairs", seconds=0.05)
    never = lambda leaves, name: wait_for([Slow(10**9)], name, seconds=0.05)
    monkeypatch.setattr("smoothdiff._black_box.wait_for", never)
    # no fault of the function, so that there is no NaN in place of it either
    f = black_box(stairs, SCALAR, on_error="nan")
    with pytest.raises(BlackBoxError, match="NPROC=2"), reraise():
        jax.block_until_ready(jax.jit(f)(jnp.ones(3)))


@pytest.mark.slow
@pytest.mark.parametrize("threads", ["1", "2"])
def test_large_arguments_need_two_threads_of_jax(threads):
    """The sum with two; with one it depends on who comes first, and there is an error, no hang.

    JAX reads NPROC as it starts, so this needs a process of its own.
    """
    script = """
import functools, os
import numpy as np, jax, jax.numpy as jnp, smoothdiff as sd
from smoothdiff import _black_box
seconds = 3.0 if os.environ["NPROC"] == "1" else 60.0
_black_box.wait_for = functools.partial(_black_box.wait_for, seconds=seconds)
f = sd.black_box(lambda x: np.float32(x.mean()), jax.ShapeDtypeStruct((), jnp.float32))
total = jax.jit(lambda xs: jnp.sum(jax.vmap(f)(xs)))
xs = jnp.ones((8, 100_000))
for _ in range(20):  # JAX does not wait for one before it begins the next
    xs = xs + 0 * total(xs)
print(float(xs.sum()))
"""
    environment = os.environ | {"NPROC": threads}
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, timeout=300
    )
    late = threads == "1" and "BlackBoxError" in done.stderr and "NPROC=2" in done.stderr
    assert late or done.stdout == "800000.0\n", done.stderr
