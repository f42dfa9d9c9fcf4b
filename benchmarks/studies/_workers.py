"""What calls of a host function cost by each executor, and what a second process is worth.

The function does nothing, or works for 10 ms of CPU time; workers import it from here.
"""

import contextlib
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import smoothdiff as sd
from benchmarks._summary import quarters

CALLS, TURNS, WORK = 200, 7, 0.01


def nothing(x: np.ndarray) -> np.ndarray:
    """Gives back what it is given."""
    return x


def work(x: np.ndarray) -> np.ndarray:
    """The same, after 10 ms of CPU time of its own."""
    end = time.thread_time() + WORK
    while time.thread_time() < end:
        pass
    return x


@contextlib.contextmanager
def dask() -> Iterator[Any]:
    """A client of two processes."""
    from distributed import Client, LocalCluster

    options: Any = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": ":0"}
    with LocalCluster(**options) as cluster, Client(cluster) as client:
        yield client


EXECUTORS: dict[str, Callable[[], Any]] = {
    "none": contextlib.nullcontext,
    "2 threads": lambda: ThreadPoolExecutor(2),
    "1 process": lambda: sd.Processes(1),
    "2 processes": lambda: sd.Processes(2),
    "Dask, 2 processes": dask,
}
ALONE = "1 process"


def measured() -> list[dict[str, Any]]:
    """A line for each executor: quartiles of milliseconds a call, in batches.

    Executors take turns, so that what else the machine does falls on all of them.
    """
    x = jnp.arange(float(CALLS))
    with contextlib.ExitStack() as stack:
        calls = {}
        for name, make in EXECUTORS.items():
            executor = stack.enter_context(make())
            for fun in (nothing, work):
                box = sd.black_box(fun, 0.0, executor=executor)
                calls[name, fun] = jax.jit(jax.vmap(box))
                calls[name, fun](x).block_until_ready()  # the workers have begun
        took: dict[tuple, list[float]] = {call: [] for call in calls}
        for _ in range(TURNS):
            for call, batch in calls.items():
                began = time.perf_counter()
                batch(x).block_until_ready()
                took[call].append(1e3 * (time.perf_counter() - began) / CALLS)
    alone = np.array(took[ALONE, work])
    return [
        {
            "executor": name,
            "ms a call of nothing": quarters(took[name, nothing]),
            "ms a call of 10 ms": quarters(took[name, work]),
            f"times as fast as {ALONE}": quarters(alone / took[name, work]),
        }
        for name in EXECUTORS
    ]
