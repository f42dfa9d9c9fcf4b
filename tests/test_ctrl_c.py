"""Ctrl-C ends a run wherever it comes, without a further evaluation."""

import concurrent.futures
import contextlib
import signal
import socket
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import smoothdiff as sd

KEY = jax.random.key(0)

pytestmark = pytest.mark.usefixtures("listens_to_ctrl_c")


def stairs(y):
    return np.float32(np.floor(8 * np.abs(y - 1)).sum())


def run(box, solver=None, **options):
    fun = lambda y, args: box(y)
    return sd.minimise(fun, jnp.zeros(3), key=KEY, solver=solver or sd.NewtonCG(0.2), **options)


@pytest.mark.parametrize("num_samples", [4, 8])
@pytest.mark.parametrize("at", [3, 21, 30])
def test_no_evaluation_begins_after_it(num_samples, at):
    """JAX may call the function in another thread, in which Python raises nothing."""
    calls = 0

    def host(y):
        nonlocal calls
        calls += 1
        if calls == at:
            signal.raise_signal(signal.SIGINT)
        return stairs(y)

    result = run(sd.black_box(host, 0.0), sd.NewtonCG(0.2, num_samples=num_samples))
    assert result.reason == "interrupted"
    time.sleep(0.05)
    assert calls == at


@pytest.mark.parametrize("num_samples", [1, 8])
@pytest.mark.parametrize("at", [25, 100])
def test_a_run_within_an_evaluation_gives_no_value_and_both_end(num_samples, at):
    """What it has found is not what the evaluation would have been."""
    calls, begun, values = 0, 0, []

    def inner(y):
        nonlocal calls
        calls += 1
        if calls == at:
            signal.raise_signal(signal.SIGINT)
        return stairs(y)

    box = sd.black_box(inner, 0.0)

    def host(y):
        nonlocal begun
        begun += 1
        values.append(stairs(y) + np.float32(run(box, max_steps=10).fun))
        return values[-1]

    result = run(sd.black_box(host, 0.0), sd.NewtonCG(0.2, num_samples=num_samples))
    assert result.reason == "interrupted"
    assert calls == at
    assert len(values) == begun - 1
    assert result.fun in (*values, np.inf)


def test_a_run_in_a_thread_beside_it_returns_what_it_found():
    def host(y):
        if len(seen) == 20:
            with contextlib.suppress(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
            beside.result(60)
            raise KeyboardInterrupt
        seen.append(stairs(y))
        return seen[-1]

    def slow(y):
        time.sleep(0.01)
        return stairs(y)

    seen: list[np.floating] = []
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        beside = pool.submit(run, sd.black_box(slow, 0.0))
        assert run(sd.black_box(host, 0.0)).reason == "interrupted"
        assert beside.result().reason == "interrupted"


def test_calls_of_threads_are_given_up():
    calls, entered = 0, threading.Event()

    def host(y):
        nonlocal calls
        calls += 1
        if calls == 30:
            signal.raise_signal(signal.SIGINT)
            entered.wait(60)  # it takes long
        return stairs(y)

    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        box = sd.black_box(host, 0.0, executor=pool)
        assert run(box, sd.NewtonCG(0.2, num_samples=16)).reason == "interrupted"
        assert calls == 30
        entered.set()


@pytest.mark.parametrize("becomes", [None, ValueError("INTERNAL"), jax.errors.JaxRuntimeError("a")])
def test_an_exception_that_is_lost_or_turned_into_another_one(becomes):
    """As in a hook of JAX's, and in an `__eq__` that C++ calls."""

    def callback(record):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            if becomes is not None:
                raise becomes from None

    assert run(sd.black_box(stairs, 0.0), callback=callback).reason == "interrupted"


def test_the_next_run_knows_nothing_of_it():
    stop = lambda record: signal.raise_signal(signal.SIGINT)
    assert run(sd.black_box(stairs, 0.0), callback=stop).reason == "interrupted"
    assert run(sd.black_box(stairs, 0.0), max_steps=3).reason == "max_steps"


def test_others_are_told_of_signals_all_the_same():
    """As a loop of asyncio's is; and more signals than a buffer holds leave room for Ctrl-C."""
    told, end = socket.socketpair()
    with told, end:
        end.setblocking(False)
        before = signal.set_wakeup_fd(end.fileno())
        usual = signal.signal(signal.SIGUSR1, lambda *_: None)

        def host(y):
            for _ in range(400):
                signal.raise_signal(signal.SIGUSR1)
            return stairs(y)

        def callback(record):
            if record.step == 20:
                with contextlib.suppress(KeyboardInterrupt):
                    signal.raise_signal(signal.SIGINT)

        try:
            assert run(sd.black_box(host, 0.0), callback=callback).reason == "interrupted"
            assert signal.set_wakeup_fd(before) == end.fileno()
            assert signal.SIGUSR1 in told.recv(100)
        finally:
            signal.set_wakeup_fd(before)
            signal.signal(signal.SIGUSR1, usual)


def test_other_threads_and_other_handlers_are_left_alone():
    before = signal.set_wakeup_fd(-1)
    signal.set_wakeup_fd(before)
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        found = pool.submit(run, sd.black_box(stairs, 0.0), max_steps=3)
        assert found.result().reason == "max_steps"
    pressed = []
    signal.signal(signal.SIGINT, lambda *_: pressed.append(True))
    stop = lambda record: signal.raise_signal(signal.SIGINT)
    assert run(sd.black_box(stairs, 0.0), callback=stop, max_steps=3).reason == "max_steps"
    assert len(pressed) == 3
    assert signal.set_wakeup_fd(before) == before
