"""Faults of a black box: what their messages say, and what is left."""

import concurrent.futures
import logging
import signal
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from awaited import awaited

import smoothdiff as sd
from smoothdiff._black_box import black_box
from smoothdiff._host_samples import BlackBoxError
from smoothdiff._reraise import reraise
from tests.counted_boxes import SCALAR, fragile

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


@pytest.mark.parametrize("text", ["no file b\udcff", "before\0after"], ids=["surrogate", "NUL"])
def test_a_text_that_xla_cannot_have(text):
    """A lone surrogate, as in names of files that are not UTF-8, ended the process."""

    def host(x):
        raise ValueError(text)

    box = black_box(host, 0.0)
    for f in (box, jax.jit(box)):
        with pytest.raises(BlackBoxError) as info:
            awaited(f, 1.0)
        assert text in str(info.value)
        assert type(info.value.__cause__) is ValueError
    escaped = text.encode("ascii", "backslashreplace").decode().replace("\0", r"\x00")
    with pytest.raises(jax.errors.JaxRuntimeError, match="BlackBoxError") as info:
        jax.block_until_ready(jax.jit(box)(2.0))
    assert escaped in str(info.value)


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
