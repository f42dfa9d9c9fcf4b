"""What goes into a black box and what comes out, said or found by the first call."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from awaited import awaited

import smoothdiff as sd
from smoothdiff._black_box import black_box
from smoothdiff._host_samples import BlackBoxError
from tests.counted_boxes import SCALAR, Counted, Flaky, stairs

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
