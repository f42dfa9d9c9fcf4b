"""Worker processes that die or hang, and Dask: each fault is that of one sample."""

import concurrent.futures
import os
import signal
import sys
import threading
import time
from concurrent.futures.process import BrokenProcessPool

import host_functions
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from awaited import awaited
from closed_forms import as_users_have_it

import smoothdiff as sd
from smoothdiff._executors import AtOnce
from smoothdiff._host_samples import Samples

FAULTS = {
    1: "raised ValueError: negative roughness",
    2: "raised WorkerDiedError: its worker process died",
    3: r"raised TimeoutError: no result within 1\.5 s",
    4: "raised SystemExit: no licence",
    5: "NoReturnError.*missing 1 required positional argument",
}


@pytest.fixture(scope="module")
def workers():
    with sd.Processes(2) as workers:
        yield workers


def box(workers, fun=host_functions.fault, **options):
    return sd.black_box(fun, 0.0, executor=workers, timeout=1.5, **options)


@pytest.mark.parametrize("at", FAULTS)
def test_a_fault_in_a_worker_is_that_of_its_sample(at, workers):
    xs = jnp.array([0.25, at, -0.5])
    with pytest.raises(sd.BlackBoxError, match=rf"(?s)sample 1 of 3: .*{FAULTS[at]}") as info:
        awaited(jax.vmap(box(workers)), xs)
    assert f"fault(array({at}., dtype=float32))" in str(info.value)
    many = jax.vmap(box(workers, on_error="nan"))(xs)
    np.testing.assert_array_equal(many, [0.5, np.nan, -1.0])


@pytest.mark.parametrize("how", [2, 3])
def test_a_sample_whose_worker_died_or_hung_is_tried_on_another(how, workers, tmp_path):
    flaky = host_functions.FirstTime(tmp_path, how)
    f = box(workers, flaky, retries=1)
    np.testing.assert_array_equal(jax.vmap(f)(jnp.arange(2.0)), [0.0, 2.0])
    assert flaky.tries() == {0.0: 2, 1.0: 2}


def test_a_worker_that_was_killed_while_it_was_idle_is_replaced():
    with sd.Processes(1) as workers:
        f = sd.black_box(host_functions.process, 0, executor=workers)
        first = int(f(0.0))
        assert first == int(f(1.0)) != os.getpid()
        os.kill(first, signal.SIGTERM)
        time.sleep(0.2)
        assert int(f(2.0)) != first


def test_a_call_of_several_functions_and_of_any_caller(workers):
    assert workers.submit(pow, 2, 5).result() == 32
    assert list(workers.map(abs, [-1, 2])) == [1, 2]
    with pytest.raises(TimeoutError, match=r"the function's own"):
        workers.submit(host_own_timeout).result()


def host_own_timeout():
    raise TimeoutError("the function's own")


def test_what_a_worker_cannot_import_ends_the_run(workers):
    local = lambda x: x
    with pytest.raises(sd.BlackBoxError, match=r"cannot import .*top level of a module"):
        sd.black_box(local, 0.0, executor=workers, on_error="nan")(1.0)


def decorated(x):
    return x


@pytest.mark.parametrize("ours", [True, False])
def test_a_decorator_hides_a_function_from_processes(ours, workers, monkeypatch):
    with concurrent.futures.ProcessPoolExecutor(1) as pool:  # which begins none
        f = sd.black_box(decorated, 0.0, executor=workers if ours else pool)
        monkeypatch.setattr(sys.modules[__name__], "decorated", f)
        with pytest.raises(sd.BlackBoxError, match=r"decorator .* f = sd.black_box\(decorated,"):
            f(1.0)


def test_the_number_of_processes():
    with pytest.raises(ValueError, match=r"workers=0: .* 1 or more"):
        sd.Processes(0)
    assert len(sd.Processes()._workers) == os.cpu_count()


def test_processes_that_were_shut_down():
    workers = sd.Processes(1)
    workers.shutdown()
    with pytest.raises(sd.BlackBoxError, match=r"takes no more calls, make a new one.*shut"):
        box(workers)(0.0)


@pytest.mark.parametrize("broken", [BrokenProcessPool, concurrent.futures.BrokenExecutor])
def test_a_function_that_raises_what_a_broken_pool_raises_loses_its_own_call(broken):
    """As one that has a pool of its own."""

    def host(x):
        if x == 1:
            raise broken("the function's own")
        return 2 * x

    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        f = sd.black_box(host, 0.0, executor=pool, on_error="nan", retries=1)
        np.testing.assert_array_equal(jax.vmap(f)(jnp.arange(3.0)), [0.0, np.nan, 4.0])
        f = sd.black_box(host, 0.0, executor=pool)
        with pytest.raises(sd.BlackBoxError, match=rf"sample 1 of 3: raised {broken.__name__}: "):
            awaited(jax.vmap(f), jnp.arange(3.0))


def test_a_broken_pool_of_others_names_the_calls_that_may_have_done_it():
    import multiprocessing

    spawn = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(1, mp_context=spawn) as pool:
        f = sd.black_box(host_functions.fault, 0.0, executor=pool, on_error="nan", retries=3)
        with pytest.raises(sd.BlackBoxError, match=r"sd\.Processes\(4\) replaces") as info:
            awaited(jax.vmap(f), jnp.array([2.0, 0.25]))
    assert "fault(array(2., dtype=float32))" in str(info.value)


def test_the_clock_starts_anew_where_a_call_changes_its_worker():
    release, places = threading.Event(), iter(range(20))

    class Moving(AtOnce):
        """Threads, of which each look at a call seems to find another one."""

        glances_every = 0.1

        def _place(self, future):
            if (place := next(places)) == 5:
                release.set()
            return place

    samples = Samples([np.array([2.0])], [0], jax.tree.structure((0,)))
    host = lambda x: release.wait(20) and x
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        late = lambda sample, value: None
        (outcome,) = Moving(pool).outcomes(host, samples, [0], retries=0, timeout=0.3, late=late)
    assert (outcome.value, outcome.error) == (2.0, None)


@pytest.mark.parametrize("executor", [None, "threads"])
def test_sys_exit_is_a_fault_of_its_sample(executor):
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        chosen = pool if executor else None
        f = sd.black_box(host_functions.fault, 0.0, on_error="nan", executor=chosen)
        np.testing.assert_array_equal(jax.vmap(f)(jnp.array([4.0, 0.5])), [np.nan, 1.0])
        f = sd.black_box(host_functions.fault, 0.0, executor=chosen)
        with pytest.raises(sd.BlackBoxError, match="SystemExit: no licence"):
            f(4.0)


def test_threads_that_all_hang_are_said_to_be_lost():
    release = threading.Event()
    host = lambda x: x if x < 1 else release.wait(20) and x
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        f = sd.black_box(host, 0.0, executor=pool, timeout=0.2, on_error="nan")
        many = jax.vmap(f)(jnp.array([0.0, 1.0, 0.0]))
        np.testing.assert_array_equal(many, [0.0, np.nan, 0.0])
        with pytest.raises(sd.BlackBoxError, match=r"no worker is left.*sd\.Processes\(4\)"):
            awaited(jax.vmap(f), jnp.array([2.0, 0.0, 0.0]))
        release.set()
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        assert sd.black_box(host, 0.0, executor=pool, timeout=20)(2.0) == 2.0


def test_results_are_taken_as_they_come():
    """The first sample ends last, and what came before it was not lost with it."""
    release = threading.Event()
    stored = []

    def host(x):
        if x == 0:
            release.wait(20)
            raise ValueError("the slowest")
        stored.append(float(x))
        if len(stored) == 3:
            release.set()
        return x

    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        f = sd.black_box(host, 0.0, executor=pool)
        with pytest.raises(sd.BlackBoxError, match="sample 0 of 4: raised ValueError: the slowest"):
            awaited(jax.vmap(f), jnp.arange(4.0))
    assert sorted(stored) == [1.0, 2.0, 3.0]


def test_what_is_no_executor():
    make = as_users_have_it(sd.black_box)
    with pytest.raises(TypeError, match=r"sd\.Processes\(4\), or a distributed\.Client"):
        make(host_functions.fault, 0.0, executor=4)
