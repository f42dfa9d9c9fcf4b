"""Retries, time limits and executors of a black box."""

import concurrent.futures
import multiprocessing
import os
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from awaited import awaited

from smoothdiff._black_box import black_box
from smoothdiff._host_samples import BlackBoxError
from tests.counted_boxes import Flaky, fragile


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


def test_a_function_that_cannot_be_sent_is_no_fault_of_a_sample():
    with concurrent.futures.ProcessPoolExecutor(1) as pool:
        box = black_box(lambda x: float(x), 0.0, executor=pool, on_error="nan")
        with pytest.raises(BlackBoxError, match="cannot be sent to processes"):
            jax.block_until_ready(jax.vmap(box)(jnp.arange(3.0)))


def test_a_timeout_without_end_is_none(threads):
    for timeout in (float("inf"), 1e12):
        box = black_box(np.sum, 0.0, executor=threads, timeout=timeout)
        np.testing.assert_array_equal(jax.vmap(box)(jnp.ones((3, 2))), [2, 2, 2])
    with pytest.raises(TypeError, match="timeout must be a real number"):
        black_box(np.sum, 0.0, executor=threads, timeout="60")  # pyright: ignore
