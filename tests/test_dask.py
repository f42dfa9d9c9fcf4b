"""Black boxes on the workers of a Dask cluster, here processes of this machine."""

import host_functions
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from awaited import awaited

import smoothdiff as sd
from smoothdiff._dask import OnDask

distributed = pytest.importorskip("distributed")

# Dask's own, as its workers come and go
pytestmark = [pytest.mark.filterwarnings("ignore"), pytest.mark.usefixtures("quiet")]


@pytest.fixture
def quiet(caplog):
    """Dask says a lot of workers that die."""
    caplog.set_level("CRITICAL", "distributed")


@pytest.fixture(scope="module")
def client():
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.LocalCluster(**options) as cluster, distributed.Client(cluster) as client:
        yield client


def box(executor, fun=host_functions.fault, **options):
    return sd.black_box(fun, 0.0, executor=executor, **options)


@pytest.mark.parametrize("way", ["client", "executor"])
def test_a_client_is_an_executor(way, client):
    executor = client if way == "client" else client.get_executor()
    xs = jnp.array([0.25, 0.25, -0.5, 1.0])
    many = jax.jit(jax.vmap(box(executor, on_error="nan")))(xs)
    np.testing.assert_array_equal(many, [0.5, 0.5, -1.0, np.nan])
    with pytest.raises(
        sd.BlackBoxError, match="sample 3 of 4: raised ValueError: negative"
    ) as info:
        jax.vmap(box(executor))(xs)
    assert "fault(array(1., dtype=float32))" in str(info.value)
    pids = jax.vmap(sd.black_box(host_functions.process, 0, executor=executor))(xs)
    assert len(set(pids.tolist())) == 2


@pytest.mark.parametrize("way", ["client", "executor"])
def test_a_call_that_failed_is_tried_again(way, client, tmp_path):
    """Dask would take the second call for the first, and give the error again."""
    flaky = host_functions.FirstTime(tmp_path, 1)
    executor = client if way == "client" else client.get_executor()
    f = box(executor, flaky, retries=1)
    np.testing.assert_array_equal(jax.vmap(f)(jnp.arange(3.0)), [0.0, 2.0, 4.0])
    assert flaky.tries() == {0.0: 2, 1.0: 2, 2.0: 2}


def test_a_worker_may_raise_anything(client):
    f = box(client, host_functions.stops_if_negative)
    with pytest.raises(host_functions.Stopped, match="negative"):
        jax.block_until_ready(jax.vmap(f)(jnp.array([0.5, -1.0, 0.25])))


@pytest.mark.parametrize("size", [2, 3])
def test_calls_go_out_in_few_messages(size, client, monkeypatch):
    monkeypatch.setattr("smoothdiff._dask._MESSAGE", 2 * size * 4)
    f = sd.black_box(np.sum, 0.0, executor=client)
    xs = jnp.arange(5.0 * size).reshape(5, size)
    np.testing.assert_array_equal(jax.vmap(f)(xs), xs.sum(1))


def test_what_runs_when_another_call_fails_is_kept(client, tmp_path):
    f = box(client, host_functions.fails_if_negative, store=tmp_path / "store")
    with pytest.raises(sd.BlackBoxError, match="sample 0 of 22: raised ValueError: negative"):
        awaited(jax.vmap(f), jnp.append(jnp.array([-0.3, 0.8]), 0.2 + jnp.arange(20) / 64))
    kept = {float(value) for _, value in sd.load_store(tmp_path / "store")}
    assert np.float32(0.8) in kept
    assert len(kept) < 10  # what no worker had was not begun


def test_large_arguments_are_sent_once(client, monkeypatch):
    sent = []
    scatter = client.scatter
    monkeypatch.setattr(client, "scatter", lambda a, **k: sent.append(a.nbytes) or scatter(a, **k))
    f = box(client, host_functions.of_an_image)
    scene = {"image": jnp.ones((512, 512)), "light": jnp.ones(3)}
    for _ in range(2):
        many = jax.jit(jax.vmap(f, in_axes=(0, None)))(jnp.arange(4.0), scene)
        np.testing.assert_array_equal(many, 2.0**18 + np.arange(4.0))
    assert sent == [4 * 2**18]


def test_more_large_arrays_than_the_workers_keep(client):
    f = box(client, host_functions.of_an_image)
    scenes = {"image": jnp.ones((10, 512, 512)) * jnp.arange(10.0)[:, None, None]}
    many = jax.vmap(f, in_axes=(None, 0))(0.0, scenes)
    np.testing.assert_array_equal(many, 2.0**18 * np.arange(10.0))


# new workers take seconds, and Dask gives up a call when four have died of it
@pytest.mark.parametrize("at", [5, *(pytest.param(at, marks=pytest.mark.slow) for at in (2, 3, 4))])
def test_a_worker_that_dies_or_hangs_loses_its_call_alone(at, client):
    xs = jnp.array([0.25, at, -0.5, 0.0, 0.0, 0.0])
    f = box(client, on_error="nan", timeout=6.0)
    want = [0.5, np.nan, -1.0, 0.0, 0.0, 0.0]
    np.testing.assert_array_equal(jax.vmap(f)(xs), want)
    with pytest.raises(sd.BlackBoxError, match="sample 1 of 6: raised"):
        awaited(jax.vmap(box(client, timeout=6.0)), xs)
    np.testing.assert_array_equal(jax.vmap(box(client))(xs.at[1].set(0.0)), [0.5, 0, -1, 0, 0, 0])


class SlowToKnow:
    """A client of a scheduler that hears of a cancellation some looks later."""

    def __init__(self):
        self.events, self.looks, self.key = [], 0, "call"

    def processing(self):
        self.looks += 1
        if self.looks > 3:
            self.events.append("forgotten")
            return {"tcp://a": ()}
        return {"tcp://a": ("call",)}

    def cancel(self):
        self.events.append("cancelled")

    def run(self, fun, workers, **_):
        self.events.append(f"killed {workers}")
        return dict.fromkeys(workers)


def test_a_worker_is_killed_once_the_scheduler_knows_that_its_call_was_cancelled():
    """Before, it would hand the call to another worker, which would then hang."""
    client = SlowToKnow()
    calls = OnDask(client)
    calls._stop(client)
    assert client.events == ["cancelled", "forgotten", "killed ['tcp://a']"]


@pytest.fixture
def threads():
    """A cluster of one worker with one thread of this process, which nothing can end."""
    options = {"n_workers": 1, "threads_per_worker": 1, "dashboard_address": None}
    with (
        distributed.LocalCluster(processes=False, **options) as cluster,
        distributed.Client(cluster) as client,
    ):
        yield client


def lose_all_workers(cluster):
    """What a cluster does with a worker that has not come back 15 s after it died."""
    while cluster.workers:
        cluster.sync(cluster.workers.popitem()[1].close)


def test_a_cluster_that_has_given_up_its_workers_is_asked_for_them_again(threads):
    lose_all_workers(threads.cluster)
    assert float(box(threads)(0.5)) == 1.0


def test_a_call_whose_large_arguments_went_with_a_worker_is_made_again(threads):
    f = box(threads, host_functions.of_an_image)
    scene = {"image": jnp.ones((512, 512))}
    assert float(f(1.0, scene)) == 2.0**18 + 1
    lose_all_workers(threads.cluster)
    assert float(f(2.0, scene)) == 2.0**18 + 2


@pytest.mark.slow
def test_workers_that_nothing_can_end_are_an_error_once_all_of_them_hang(threads):
    f = box(threads, host_functions.a_while, on_error="nan", timeout=0.5)
    assert np.isnan(f(3.0))
    with pytest.raises(sd.BlackBoxError, match=r"no worker is left.* leave out --no-nanny"):
        f(0.0)


@pytest.mark.slow
def test_a_sample_whose_worker_died_is_tried_again(client, tmp_path):
    flaky = host_functions.FirstTime(tmp_path, 2)
    np.testing.assert_array_equal(jax.vmap(box(client, flaky))(jnp.arange(2.0)), [0.0, 2.0])
