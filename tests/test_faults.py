"""Host functions with a fault at one point in ten, under everything that makes their calls.

A run ends with an answer as good as without faults, or with an error that names the point. It and a
second one pay for no point twice, but for those that failed, and under Dask those that were lost.
FAULT_RUNS=50 in the environment makes 50 runs of each in place of a few.
"""

import contextlib
import os
from concurrent.futures import ThreadPoolExecutor

import host_functions
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import smoothdiff as sd

# what becomes a NaN under each way of making calls, if it is to; a wrong shape is always an error
KINDS = {
    "plain": ("raises", "NaN"),
    "threads": ("raises", "NaN", "hangs"),
    "processes": ("raises", "NaN", "hangs", "dies"),
    "dask": ("raises", "NaN", "hangs", "dies"),
}
# of minimise; of least_squares, which takes fewer evaluations, three times as many
RUNS = {"plain": 8, "threads": 1, "processes": 1, "dask": 1}
# half the sum of squares: about 1 at the start, and without faults below this at the end
GOOD = 1e-4

# A worker that dies takes seconds to begin again, and Dask by itself gives up a call after four
# deaths: here a fork of a process that has imported Dask, and the first.
QUICKLY_REPLACED = {
    "distributed.worker.multiprocessing-method": "forkserver",
    "distributed.scheduler.allowed-failures": 0,
}

# Dask warns as its workers come and go
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]


@contextlib.contextmanager
def executor_of(way):
    if way == "threads":
        with ThreadPoolExecutor(4) as pool:
            yield pool
    elif way == "processes":
        with sd.Processes(2) as workers:
            yield workers
    elif way == "dask":
        dask, distributed = map(pytest.importorskip, ("dask", "distributed"))
        options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
        with (
            dask.config.set(QUICKLY_REPLACED),
            distributed.LocalCluster(**options) as cluster,
            distributed.Client(cluster) as client,
        ):
            yield client
            # a worker that is just being replaced cannot be closed; all runs have ended, so that
            # it is no fault of ours if Dask takes longer
            with contextlib.suppress(distributed.TimeoutError):
                client.wait_for_workers(2, timeout=60)
    else:
        yield None


def runs_of(call, way, kinds, folder, **options):
    """Each run twice: the host function, its good calls after the first of both, how runs ended.

    All have the same program, as it is compiled once, and the same store.
    """
    fun = host_functions.Faulty(folder / "calls", kinds, call == "least_squares")
    runs = int(os.environ.get("FAULT_RUNS", RUNS[way] * (3 if fun.residuals else 1)))
    starts = np.random.default_rng(0).uniform(-1, 1, (runs, 2))
    with executor_of(way) as executor:
        timeout = {} if executor is None else {"timeout": 2.0}
        out = jnp.zeros(2) if fun.residuals else 0.0
        store = folder / "store"
        box = sd.black_box(fun, out, executor=executor, store=store, **timeout, **options)
        kind = sd.GaussNewton if fun.residuals else sd.NewtonCG
        solver = kind(0.3, num_samples=None if executor is None else 4, nonfinite="drop")
        loss = lambda y, args: box(y)
        limits = {"key": jax.random.key(0), "target": GOOD / 10}

        def run(y0):
            try:
                y0 = jnp.asarray(y0, jnp.float32)
                return getattr(sd, call)(loss, y0, solver=solver, **limits)
            except sd.MinimiseError as error:
                return error

        first = [run(y0) for y0 in starts]
        before = fun.calls()[0]
        again = [run(y0) for y0 in starts]
    return fun, before, first + again


def check_paid_once(way, good):
    """No good point is called twice.

    Under Dask a good call may be lost with the worker that had its result, or time out while
    workers start: then it is made again.
    """
    if way != "dask":
        assert set(good.values()) == {1}


CASES = [f"{call} {way}" for way in KINDS for call in ("minimise", "least_squares")]


@pytest.mark.parametrize("case", CASES)
def test_faults_leave_the_answer_as_good_and_nothing_is_paid_for_twice(case, tmp_path):
    call, way = case.split()
    nan = {"on_error": "nan", "on_nonfinite": "nan"}
    fun, before, ends = runs_of(call, way, KINDS[way], tmp_path, **nan)
    for end in ends:
        assert not isinstance(end, sd.MinimiseError), end
        assert end.fun < GOOD
    good, bad = fun.calls()
    assert bad  # else this tells nothing
    check_paid_once(way, good)
    if way != "dask":
        assert good == before  # the second runs took all from the store


@pytest.mark.parametrize("case", CASES)
def test_an_error_names_the_point_and_nothing_is_paid_for_twice(case, tmp_path):
    call, way = case.split()
    fun, _, ends = runs_of(call, way, (*KINDS[way], "shape"), tmp_path)
    good, bad = fun.calls()
    assert bad
    for end in ends:
        if isinstance(end, sd.MinimiseError):
            assert any(repr(point) in str(end) for point in bad), end
        else:
            assert end.fun < GOOD
    # after an error the second run may call points that the first had not come to
    check_paid_once(way, good)
