"""Host functions as JAX functions: how often they are called, and with what."""

import concurrent.futures
import logging
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import as_users_have_it

from smoothdiff._black_box import black_box
from smoothdiff._host_samples import BlackBoxError, wait_for
from smoothdiff._reraise import reraise
from tests.counted_boxes import SCALAR, fragile, stairs, stairs_box


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


def test_arguments_by_name():
    box = black_box(lambda x, shift=0.5, scale=2.0: scale * (x + shift), 0.0)
    assert box(x=1.0) == 3.0
    assert box(1.0, scale=4.0) == 6.0
    assert jax.jit(lambda x: box(scale=x, x=1.0, shift=1.0))(3.0) == 6.0
    with pytest.raises(TypeError, match=r"black box '<lambda>': .*unexpected .*'size'"):
        box(1.0, size=2.0)
    with pytest.raises(TypeError, match="by their places, and scale can only be given by name"):
        black_box(lambda x, *, scale: x, 0.0)(1.0, scale=2.0)
    with pytest.raises(TypeError, match="by their places, not by names such as 'out'"):
        black_box(max, 0.0)(1.0, out=2.0)


def test_what_is_no_array_is_named_and_a_method_most_of_all():
    class Simulator:
        @black_box
        def run(self, x):
            return x

    with pytest.raises(TypeError, match=r"(?s)'run' takes .*black_box\(Simulator\(\.\.\.\)\.run"):
        Simulator().run(1.0)
    with pytest.raises(TypeError, match=r"pytrees of them, not 'fast'$"):
        black_box(lambda x, mode: x, 0.0)(1.0, "fast")


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
    monkeypatch.setattr("smoothdiff._callbacks.wait_for", never)
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
from smoothdiff import _callbacks
seconds = 3.0 if os.environ["NPROC"] == "1" else 60.0
_callbacks.wait_for = functools.partial(_callbacks.wait_for, seconds=seconds)
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
