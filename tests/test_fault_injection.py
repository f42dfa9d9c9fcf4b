"""Host functions with a fault at one point in ten, under everything that makes calls.

A run ends with an answer as good as without faults, or with an error that names the point, and a
second one pays for no point twice. FAULT_RUNS=50 in the environment makes 50 runs of each, under
all executors.
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

RUNS = int(os.environ.get("FAULT_RUNS", "1"))
EVALUATIONS = 60
# what is a fault of one sample wherever it happens, and what only a worker process survives
MILD, HARD = ("raise", "nan"), ("exit", "unpickled", "hang", "die")
WAYS = {"plain": MILD, "threads": MILD, "processes": MILD + HARD, "dask": MILD + HARD}
# all of them take half an hour
if "FAULT_RUNS" not in os.environ:
    WAYS = {"plain": MILD}

pytestmark = pytest.mark.filterwarnings("ignore")  # Dask's own, as its workers come and go


@contextlib.contextmanager
def executor_of(way):
    if way == "threads":
        with ThreadPoolExecutor(2) as pool:
            yield pool
    elif way == "processes":
        with sd.Processes(2) as workers:
            yield workers
    elif way == "dask":
        distributed = pytest.importorskip("distributed")
        options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
        with distributed.LocalCluster(**options) as cluster, distributed.Client(cluster) as client:
            yield client
    else:
        yield None


@pytest.fixture(scope="module", params=[*WAYS])
def way(request):
    with executor_of(request.param) as executor:
        yield request.param, executor


def search(call, fun, seed, way, store, **options):
    """A run of a solver; `fun` gives residuals, or with "minimise" one number."""
    name, executor = way
    timeout = {} if name in ("plain", "threads") else {"timeout": 2.0}
    out = jnp.zeros(3) if call == "least_squares" else 0.0
    box = sd.black_box(fun, out, executor=executor, store=store, **timeout, **options)
    kind = sd.GaussNewton if call == "least_squares" else sd.NewtonCG
    return getattr(sd, call)(
        lambda y, args: box(y),
        jnp.zeros(2),
        key=jax.random.key(seed),
        solver=kind(0.5, num_samples=4, nonfinite="drop"),
        max_evaluations=EVALUATIONS,
    )


@pytest.mark.slow
@pytest.mark.parametrize("call", ["minimise", "least_squares"])
@pytest.mark.parametrize("seed", range(RUNS))
def test_faults_leave_the_answer_as_good_and_nothing_is_paid_for_twice(seed, call, way, tmp_path):
    fun = host_functions.Faulty(tmp_path / "calls", WAYS[way[0]], call == "least_squares")
    nan = {"on_error": "nan", "on_nonfinite": "nan"}
    first = search(call, fun, seed, way, tmp_path / "store", **nan)
    faults = fun.faults()
    assert faults  # else this tells nothing
    np.testing.assert_allclose(first.y, fun.TARGET, atol=0.02)
    again = search(call, fun, seed, way, tmp_path / "store", **nan)
    np.testing.assert_array_equal(again.y, first.y)
    paid = {point: times for point, times in fun.calls().items() if point not in faults}
    assert set(paid.values()) == {1}


@pytest.mark.slow
@pytest.mark.parametrize("call", ["minimise", "least_squares"])
@pytest.mark.parametrize("kind", [*MILD, "shape"])
def test_an_error_names_the_point_and_a_second_run_pays_for_nothing(kind, call, way, tmp_path):
    if way[0] == "dask":
        pytest.skip("as with processes")
    fun = host_functions.Faulty(tmp_path / "calls", (kind,), call == "least_squares")
    faults: set = set()
    for _ in range(2):
        with pytest.raises(sd.MinimiseError) as info:
            search(call, fun, 0, way, tmp_path / "store")
        # several calls are made at once, and one of them may be a fault as well
        faults = fun.faults()
        assert any(repr(np.array(fault, np.float32)) in str(info.value) for fault in faults)
    paid = {point: times for point, times in fun.calls().items() if point not in faults}
    assert set(paid.values()) == {1}
