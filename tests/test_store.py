"""A store of evaluations: what is in it is never paid for again, whatever ended the run."""

import concurrent.futures
import contextlib
import shutil
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import host_functions
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from awaited import awaited
from closed_forms import as_users_have_it

import smoothdiff as sd


@pytest.fixture
def path(tmp_path):
    return tmp_path / "deep" / "store.db"


class Counted:
    """Twice x, or an error; remembers what it was called with."""

    def __init__(self, bad=()):
        self.bad, self.calls = bad, []

    def __call__(self, x):
        self.calls.append(np.array(x))
        if float(np.max(x)) in self.bad:
            raise ValueError("no licence")
        return 2 * x


def stored(path):
    return {float(x): float(value) for (x,), value in sd.load_store(path)}


@pytest.mark.parametrize("batched", [False, True])
def test_a_second_run_pays_for_nothing(batched, path):
    xs = jnp.array([0.5, 1.5, 0.5, 2.5])
    for calls in (1 if batched else 3, 0):
        host = Counted()
        f = sd.black_box(host, 0.0, batched=batched, store=path)
        np.testing.assert_array_equal(jax.jit(jax.vmap(f))(xs), 2 * xs)
        assert len(host.calls) == calls
    assert stored(path) == {0.5: 1.0, 1.5: 3.0, 2.5: 5.0}


@pytest.mark.parametrize("batched", [False, True])
def test_a_point_that_comes_several_times_in_a_batch_is_paid_for_once(batched, path):
    """As the ends of steps at several radii do, where the model's is within all of them."""
    host = Counted()
    f = sd.black_box(
        lambda x: np.where(host(x) == 2, np.nan, 2 * x),
        0.0,
        batched=batched,
        store=path,
        on_nonfinite="nan",
    )
    f(0.5)
    host.calls.clear()
    xs = jnp.array([3.0, 0.5, 1.0, 3.0, 1.0, 0.5, 2.0, 3.0])
    nan = np.nan
    np.testing.assert_array_equal(jax.vmap(f)(xs), [6, 1, nan, 6, nan, 1, 4, 6])
    assert np.concatenate(host.calls, axis=None).tolist() == [3.0, 1.0, 2.0]


@pytest.mark.parametrize("batched", [False, True])
def test_only_what_is_missing_is_evaluated(batched, path):
    seen = []

    def host(x, image):
        seen.append((np.atleast_1d(x).tolist(), image.strides[: image.ndim - 1]))
        return x + image.sum(axis=(-1, -2))

    image = jnp.ones((3, 4))
    f = jax.vmap(sd.black_box(host, 0.0, batched=batched, store=path), in_axes=(0, None))
    f(jnp.array([1.0, 3.0]), image)
    seen.clear()
    np.testing.assert_array_equal(f(jnp.arange(5.0), image), 12 + np.arange(5.0))
    if batched:
        assert seen == [([0.0, 2.0, 4.0], (0, 16))]  # the image is not copied for each
    else:
        assert [x for x, _ in seen] == [[0.0], [2.0], [4.0]]
    f(jnp.arange(5.0), image + 1)
    assert len(sd.load_store(path)) == 10


def test_every_dtype_and_structure_comes_back(path):
    calls = []

    def host(scene, count, nothing):
        calls.append(1)
        gain = np.asarray(scene["gain"], np.float32)
        return {"image": np.ones((2, 3)) * gain, "parts": [count > 1, (count * 2, gain)]}

    out = {
        "image": jax.ShapeDtypeStruct((2, 3), jnp.float16),
        "parts": [True, (np.int32(0), jnp.bfloat16(0))],
    }
    scene = {"gain": jnp.bfloat16(1.5), "empty": jnp.zeros((0, 2)), "none": None}
    values = [
        sd.black_box(host, out, store=path)(scene, jnp.int8(3), jnp.zeros(0)) for _ in range(2)
    ]
    assert len(calls) == 1
    same = lambda a, b: a.dtype == b.dtype and np.array_equal(a, b)
    assert jax.tree.all(jax.tree.map(same, *values))
    ((args, value),) = sd.load_store(path)
    assert jax.tree.structure(args) == jax.tree.structure((scene, 0, 0))
    assert jax.tree.all(jax.tree.map(same, value, values[0]))
    assert (args[0]["gain"].dtype, args[0]["empty"].shape) == (jnp.bfloat16, (0, 2))


class Pair(NamedTuple):
    first: Any
    second: Any


def test_nodes_that_a_file_cannot_have(path):
    host = Counted()
    f = lambda: sd.black_box(
        lambda pair: Pair(host(pair.first), pair.second), Pair(0.0, 0.0), store=path
    )
    for _ in range(2):
        got = f()(Pair(jnp.float32(1.0), jnp.float32(2.0)))
        assert got == Pair(2.0, 2.0)
    assert len(host.calls) == 1
    assert sd.load_store(path) == [(tuple(Pair(1.0, 2.0)), tuple(Pair(2.0, 2.0)))]


class Moded:
    """An array and a setting, of which its text says nothing."""

    def __init__(self, x, mode):
        self.x, self.mode = x, mode

    def __repr__(self):
        return f"{self.x}"


jax.tree_util.register_pytree_node(
    Moded, lambda node: ((node.x,), node.mode), lambda mode, leaves: Moded(*leaves, mode)
)


class Curve(eqx.Module):
    x: jax.Array
    of: Callable = eqx.field(static=True)


def test_arguments_that_differ_in_static_data_are_other_points(path):
    calls, times = [], lambda k: lambda x: k * x
    mode = lambda node: np.float32(calls.append(1) or node.x * node.mode)
    function = lambda curve: np.float32(calls.append(1) or curve.of(curve.x))
    other = path.with_name("other.db")
    for paid in (4, 0):
        calls.clear()
        f, g = sd.black_box(mode, 0.0, store=path), sd.black_box(function, 0.0, store=other)
        assert [float(f(Moded(1.0, k))) for k in (1, 2)] == [1.0, 2.0]
        assert [float(g(Curve(jnp.ones(()), times(k)))) for k in (1, 2)] == [1.0, 2.0]
        assert len(calls) == paid
    assert len(sd.load_store(path)) == len(sd.load_store(other)) == 2


def test_arguments_of_other_types_and_bits_are_other_points(path, x64):
    host = Counted()
    f = sd.black_box(host, store=path)
    for x in (0.0, -0.0, jnp.float32(0.0), jnp.zeros(1), jnp.int32(0), 5e-324):
        f(x)
    assert len(host.calls) == len(sd.load_store(path)) == 6


def test_another_promise_is_not_what_was_stored(path):
    host = Counted()
    assert sd.black_box(host, np.float32(0), store=path)(0.1).dtype == jnp.float32
    assert sd.black_box(host, np.float16(0), store=path)(0.1).dtype == jnp.float16
    assert len(host.calls) == 2


@pytest.mark.parametrize("batched", [False, True])
def test_what_is_returned_is_found_in_the_store(batched, path):
    host = Counted()
    for _ in range(2):
        f = sd.black_box(host, batched=batched, store=path)
        assert f(jnp.ones(3)).tolist() == [2.0, 2.0, 2.0]
    assert len(host.calls) == 1


# faults


@pytest.mark.parametrize("threaded", [False, True])
def test_a_batch_that_fails_keeps_what_succeeded(threaded, path):
    xs = jnp.arange(4.0)
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        host, executor = Counted(bad=(2.0,)), pool if threaded else None
        with pytest.raises(sd.BlackBoxError, match=r"sample 2 of 4: .*no licence"):
            awaited(jax.vmap(sd.black_box(host, 0.0, store=path, executor=executor)), xs)
    assert stored(path).items() >= {0.0: 0.0, 1.0: 2.0}.items()
    before = len(stored(path))
    host = Counted()
    f = jax.vmap(sd.black_box(host, 0.0, store=path))
    with pytest.warns(RuntimeWarning, match="when fun.bad was another"):
        values = f(xs)
    np.testing.assert_array_equal(values, 2 * xs)
    assert len(host.calls) == 4 - before


def test_calls_under_way_when_a_batch_fails_are_kept(path):
    fail, go_on, ended = threading.Event(), threading.Event(), threading.Event()

    def host(x):
        if x == 0:
            fail.wait(20)
            raise ValueError("first")
        fail.set()
        go_on.wait(20)
        ended.set()
        return x

    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        f = sd.black_box(host, 0.0, executor=pool, store=path)
        with pytest.raises(sd.BlackBoxError, match="first"):
            awaited(jax.vmap(f), jnp.arange(2.0))
        assert stored(path) == {}
        go_on.set()
        ended.wait(20)
    for _ in range(100):  # the pool says that it has ended a moment before it tells us
        if stored(path):
            break
        time.sleep(0.05)
    assert stored(path) == {1.0: 1.0}


@pytest.mark.parametrize("batched", [False, True])
def test_neither_errors_nor_nan_are_kept(batched, path):
    host = lambda x: np.where(x == 1, np.nan, x)
    xs = jnp.arange(3.0)
    f = sd.black_box(host, 0.0, batched=batched, store=path, on_nonfinite="nan")
    for _ in range(2):
        np.testing.assert_array_equal(jax.vmap(f)(xs), [0.0, np.nan, 2.0])
    assert stored(path) == {0.0: 0.0, 2.0: 2.0}
    f = sd.black_box(host, 0.0, batched=batched, store=path)
    with pytest.raises(sd.BlackBoxError, match="not finite"):
        awaited(jax.vmap(f), jnp.array([1.0, 3.0]))
    assert (3.0 in stored(path)) == batched


def test_a_store_that_cannot_be_written_loses_nothing_else(path):
    host = Counted()

    def gone(x):
        if x == 1:
            shutil.rmtree(path.parent)
        return host(x)

    f = sd.black_box(gone, 0.0, store=path)
    with pytest.warns(RuntimeWarning, match="nothing was written to the store .*, the calls go on"):
        values = jax.vmap(f)(jnp.arange(3.0))
    np.testing.assert_array_equal(values, [0.0, 2.0, 4.0])


KILLED = """
import os, sys, numpy as np, jax, jax.numpy as jnp, smoothdiff as sd
calls = 0
def host(x):
    global calls
    calls += 1
    if calls == int(sys.argv[2]):
        os.kill(os.getpid(), 9)
    return np.floor(4 * np.abs(x - 0.6)).sum()
box = sd.black_box(host, np.float32(0), store=sys.argv[1])
xs = jax.random.normal(jax.random.key(0), (12, 2))
print(jax.vmap(box)(xs).tolist(), calls)
"""


@pytest.mark.slow
def test_a_run_that_is_killed_is_paid_for_once(path):
    run = lambda at: subprocess.run(
        [sys.executable, "-c", KILLED, str(path), str(at)], capture_output=True, text=True
    )
    assert run(8).returncode == -9
    assert len(sd.load_store(path)) == 7
    again = run(0)
    assert again.stdout.endswith(" 5\n"), again.stderr
    known = {tuple(x.tolist()): float(value) for (x,), value in sd.load_store(path)}
    assert len(known) == 12
    assert all(v == np.floor(4 * np.abs(np.subtract(x, 0.6))).sum() for x, v in known.items())


SHARED = """
import sys, numpy as np
from smoothdiff._host_samples import Samples
from smoothdiff._store import Store
import jax
tree = jax.tree.structure((0,))
store = Store(sys.argv[1], np.sin)
store.check()
for x in range(100):
    samples = Samples([np.float64([x])], [0], tree)
    store.put(samples, 0, [np.float64(x)], jax.tree.structure(0))
    assert [found.tree() for found in store.find(store.points(samples))] == [x]
"""


@pytest.mark.slow
def test_several_processes_write_at_once(path):
    start = lambda: subprocess.Popen(
        [sys.executable, "-W", "error", "-c", SHARED, str(path)], stderr=subprocess.PIPE, text=True
    )
    processes = [start() for _ in range(3)]
    for process in processes:
        _, err = process.communicate(timeout=100)
        assert process.returncode == 0, err
    assert stored(path) == {float(x): float(x) for x in range(100)}


# whose it is


def test_the_store_of_another_function_is_refused_until_it_is_forgotten(path):
    shifted = lambda by: lambda x: x + by
    assert sd.black_box(shifted(1.0), 0.0, store=path)(0.5) == 1.5
    other = sd.black_box(shifted(2.0), 0.0, store=path)
    message = r"was written when fun.by was another: name another file. .*delete from function"
    with pytest.raises(ValueError, match=message):
        other(0.5)
    with pytest.raises(ValueError, match=message):
        jax.jit(jax.vmap(other))(jnp.ones(2))
    with sqlite3.connect(path) as file:
        file.execute("delete from function")
    file.close()
    assert other(0.5) == 1.5
    assert other(1.5) == 3.5


def test_what_calls_change_is_nothing_of_the_function(path):
    count = 0

    def host(x):
        nonlocal count
        count += 1
        return x + 1

    for x in (1.0, 2.0, 1.0):
        assert sd.black_box(host, 0.0, store=path)(x) == x + 1
    assert count == 2


class Scaled:
    """Has a setting that can change in place."""

    def __init__(self, k):
        self.k = k

    def __call__(self, x):
        return self.k * x


def test_values_of_a_function_that_differs_are_not_added(path):
    box = lambda k: sd.black_box(Scaled(k), 0.0, store=path)
    assert box(2.0)(1.0) == 2.0
    other = box(3.0)
    with pytest.warns(RuntimeWarning, match=r"fun.k was another; .* none are added: name another"):
        assert other(1.0) == 2.0
    assert other(5.0) == 15.0
    assert box(2.0)(5.0) == 10.0
    assert stored(path) == {1.0: 2.0, 5.0: 10.0}


def test_a_function_that_changes_between_calls_is_another(path):
    k, scaled = 2.0, Scaled(2.0)
    f = jax.jit(sd.black_box(lambda x: k * x, 0.0, store=path))
    g = jax.jit(sd.black_box(scaled, 0.0, store=path.with_name("g.db")))
    assert (awaited(f, 1.0), awaited(g, 1.0)) == (2.0, 2.0)
    k = scaled.k = 3.0
    with pytest.raises(ValueError, match=r"fun.k was another: name another file"):
        awaited(f, 5.0)
    with pytest.warns(RuntimeWarning, match=r"fun.k was another"):
        assert awaited(g, 5.0) == 15.0
    k = scaled.k = 2.0
    assert (awaited(f, 5.0), awaited(g, 5.0)) == (10.0, 10.0)
    assert stored(path) == stored(path.with_name("g.db")) == {1.0: 2.0, 5.0: 10.0}


def test_a_late_change_by_the_calls_is_nothing_of_the_function(path):
    fails, values = 0, []

    def host(x):
        nonlocal fails
        fails += bool(x > 2)
        return x

    f = jax.jit(sd.black_box(host, 0.0, store=path))
    for x in (1.0, 2.0, 3.0, 4.0):
        values.append(awaited(f, x))
    assert (values, fails, len(stored(path))) == ([1.0, 2.0, 3.0, 4.0], 2, 4)


@pytest.mark.parametrize("content", [b"not a store at all" * 100, b"SQLite format 3"])
def test_a_file_that_is_no_store(content, tmp_path):
    path = tmp_path / "notes.txt"
    path.write_bytes(content)
    with pytest.raises(ValueError, match="is not a store of evaluations: name another file"):
        sd.black_box(Counted(), 0.0, store=path)(1.0)
    with pytest.raises(ValueError, match="is not a store of evaluations: name another file"):
        sd.load_store(path)
    assert path.read_bytes() == content
    with pytest.raises(FileNotFoundError, match=r"no store .*nowhere"):
        sd.load_store(tmp_path / "nowhere")
    with pytest.raises(TypeError, match="store must be a path"):
        as_users_have_it(sd.black_box)(Counted(), 0.0, store=True)


@pytest.mark.parametrize("table", ["notes (text)", "evaluations (at, score)"])
def test_the_file_of_another_program_is_left_alone(table, tmp_path):
    path = tmp_path / "theirs.db"
    with contextlib.closing(sqlite3.connect(path)) as file:
        file.execute(f"create table {table}")
    content = path.read_bytes()
    with pytest.raises(ValueError, match="is not a store of evaluations: name another file"):
        sd.load_store(path)
    assert path.read_bytes() == content


def test_nothing_is_added_to_the_tables_of_another_program(tmp_path):
    path = tmp_path / "theirs.db"
    with contextlib.closing(sqlite3.connect(path)) as file:
        file.execute("create table notes (text)")
    with pytest.raises(ValueError, match="is not a store of evaluations: name another file"):
        sd.black_box(Counted(), 0.0, store=path)(1.0)
    with contextlib.closing(sqlite3.connect(path)) as file:
        assert file.execute("select name from sqlite_master").fetchall() == [("notes",)]


@pytest.mark.parametrize("made", [[], ["function"], ["function", "arrays"]])
def test_a_store_that_is_being_made_is_empty(made, tmp_path):
    path = tmp_path / "store.db"
    path.touch()
    with contextlib.closing(sqlite3.connect(path)) as file:
        for table in made:
            file.execute(f"create table {table} (id)")
    assert sd.load_store(path) == []


def test_a_directory_is_no_store(tmp_path):
    with pytest.raises(ValueError, match="is a directory"):
        sd.load_store(tmp_path)


# what it is for


def test_a_large_array_that_all_points_share_is_there_once(path):
    f = sd.black_box(lambda x, image: x + image.sum(), 0.0, store=path)
    jax.vmap(f, in_axes=(0, None))(jnp.arange(20.0), jnp.ones((256, 256)))
    assert sum(file.stat().st_size for file in path.parent.iterdir()) < 1_000_000
    assert [args[1].shape for args, _ in sd.load_store(path)] == [(256, 256)] * 20


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver",
    [pytest.param(sd.NewtonCG(0.2), marks=pytest.mark.slow), None],
    ids=["given", "default"],
)
def test_a_run_that_is_made_again_costs_nothing_and_gives_the_same_bits(solver, path):
    def once():
        host = Counted()
        f = sd.black_box(lambda y: np.sum(np.floor(4 * host(y)) ** 2), 0.0, store=path)
        fun, y0, key = lambda y, args: f(y - 0.7), jnp.ones(2), jax.random.key(0)
        return sd.minimise(fun, y0, key=key, solver=solver, max_steps=20), len(host.calls)

    (first, paid), (second, again) = once(), once()
    assert paid > again == 0
    np.testing.assert_array_equal(first.y, second.y)
    assert (first.fun, first.evaluations) == (second.fun, second.evaluations)


@pytest.mark.slow
def test_a_search_begins_with_what_is_there(path):
    f = sd.black_box(lambda y: np.sum(np.abs(y - 1)), 0.0, store=path)
    y0, key = jnp.zeros(2), jax.random.key(0)
    sd.minimise(lambda y, args: f(y), y0, key=key, max_evaluations=40)
    known = sd.load_store(path)
    search = sd.Search(y0, key=key)
    search.tell([y for (y,), _ in known], [value for _, value in known])
    assert search.evaluations == len(known)
    assert search.fun == min(value for _, value in known)


def test_workers_of_a_pool(path):
    with sd.Processes(2) as workers:
        xs = jnp.array([0.5, 2.0, -0.5])
        for _ in range(2):
            f = sd.black_box(
                host_functions.fault, 0.0, executor=workers, on_error="nan", store=path
            )
            np.testing.assert_array_equal(jax.vmap(f)(xs), [1.0, np.nan, -1.0])
    assert stored(path) == {0.5: 1.0, -0.5: -1.0}


def test_a_store_that_cannot_be_opened_is_named_at_once(tmp_path):
    began = time.monotonic()
    with pytest.raises(OSError, match="cannot be opened as a store: "):
        sd.black_box(lambda x: x, 0.0, store=tmp_path)(1.0)
    assert time.monotonic() - began < 30
