"""`Processes`: worker processes of which one that dies or hangs is replaced."""

import concurrent.futures
import contextlib
import os
import pickle
import queue
import signal
import sys
from collections.abc import Callable
from typing import Any

Seconds = int | float | None


class WorkerDiedError(RuntimeError):
    """The worker process of a call died; another one takes its place."""


class NotImportableError(RuntimeError):
    """A worker process cannot have the function."""


_HIDDEN = (
    "the decorator has taken its name, so leave the decorator out and give the box a name of its "
    "own, as f = sd.black_box({}, ...)"
)
_INSIDE = (
    "define it at the top level of a module, neither in a notebook nor in another function, and "
    'put the work of a script under if __name__ == "__main__":'
)


def how_to_import(fn: Callable) -> str:
    """What to do so that other processes can import a function, which they cannot now."""
    found = sys.modules.get(getattr(fn, "__module__", None) or "")
    name = getattr(fn, "__qualname__", "")
    for part in name.split("."):
        found = getattr(found, part, None)
    return _HIDDEN.format(name) if getattr(found, "__wrapped__", None) is fn else _INSIDE


class Processes(concurrent.futures.Executor):
    """Worker processes for functions that crash or hang: these lose their own call, no other.

    As the `executor` of `smoothdiff.black_box`. A worker that dies, by a segmentation fault, by
    `os._exit`, or because memory ran out, fails only the call that it had, which `retries` then
    makes again on a fresh worker. One that takes longer than the `timeout` is killed; the time
    begins when the worker has the call, and has imported what it needs.

    Each is a `concurrent.futures.ProcessPoolExecutor` of one process, so that it is known which
    call a process died of. Processes are spawned, as a fork of JAX can hang, when they are first
    needed. So the function must be at the top level of a module that can be imported, and the work
    of a script must stand under `if __name__ == "__main__":`.

    Args:
        workers: How many processes. By default as many as there are cores.

    Raises:
        ValueError: If there is to be none.

    Example:
        >>> import math, jax, jax.numpy as jnp, smoothdiff as sd
        >>> with sd.Processes(2) as workers:
        ...     f = sd.black_box(math.floor, 0, executor=workers, timeout=60, retries=1)
        ...     stairs = jax.vmap(f)(jnp.array([0.5, 1.5]))
        >>> stairs
        Array([0, 1], dtype=int32)

    Source: own.
    """

    def __init__(self, workers: int | None = None):
        count = os.cpu_count() or 1 if workers is None else workers
        if count < 1:
            raise ValueError(f"workers={workers}: give the number of processes, 1 or more")
        # a thread for each worker waits for it; the idle ones are in the queue
        self._threads = concurrent.futures.ThreadPoolExecutor(count, "smoothdiff-worker")
        self._idle: queue.SimpleQueue[_Worker] = queue.SimpleQueue()
        self._workers = [_Worker() for _ in range(count)]
        for worker in self._workers:
            self._idle.put(worker)

    def submit(
        self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any
    ) -> concurrent.futures.Future:
        """As for any executor; a call may take as long as it wants."""
        return self.submit_within(None, fn, *args, **kwargs)

    def submit_within(
        self, seconds: Seconds, fn: Callable[..., Any], /, *args: Any, **kwargs: Any
    ) -> concurrent.futures.Future:
        """A call that raises TimeoutError if it takes longer."""
        return self._threads.submit(self._call, seconds, fn, args, kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Ends the workers once their calls have ended."""
        self._threads.shutdown(wait, cancel_futures=cancel_futures)
        if wait:
            for worker in self._workers:
                worker.end()

    def _call(self, seconds: Seconds, fn: Callable, args: tuple, kwargs: dict) -> Any:
        worker = self._idle.get()
        try:
            return worker.call(seconds, fn, args, kwargs)
        finally:
            self._idle.put(worker)


class _Worker:
    """One process at a time."""

    def __init__(self):
        self._pool: concurrent.futures.ProcessPoolExecutor | None = None
        self._pid = 0
        self._knows: Any = None

    def call(self, seconds: Seconds, fn: Callable, args: tuple, kwargs: dict) -> Any:
        """What the function returns; a process that dies or takes longer is the last one's end."""
        future = self._begin(fn, args, kwargs)
        try:
            return future.result(seconds)
        except concurrent.futures.BrokenExecutor as error:
            self.end()
            raise WorkerDiedError(
                "its worker process died: it crashed, ran out of memory, or what the function "
                f"returned or raised cannot be unpickled ({error})"
            ) from error.__cause__
        except TimeoutError:
            if future.done():  # meanwhile, or the function's own
                return future.result()
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._pid, getattr(signal, "SIGKILL", signal.SIGTERM))
            self.end()
            raise TimeoutError(f"no result within {seconds} s") from None

    def end(self) -> None:
        """Ends the process, if there is one."""
        if self._pool is not None:
            self._pool.shutdown()
        self._pool = self._knows = None

    def _begin(self, fn: Callable, args: tuple, kwargs: dict) -> concurrent.futures.Future:
        """The call, in a process that has imported the function."""
        try:
            return self._informed(fn).submit(fn, *args, **kwargs)
        except concurrent.futures.BrokenExecutor:  # it died while it had nothing to do
            self.end()
        try:
            return self._informed(fn).submit(fn, *args, **kwargs)
        except concurrent.futures.BrokenExecutor as error:
            raise _not_importable(fn, error) from error.__cause__

    def _informed(self, fn: Callable) -> "concurrent.futures.ProcessPoolExecutor":
        if self._pool is None:
            import multiprocessing  # not with the package, of which few need it

            context = multiprocessing.get_context("spawn")
            self._pool = concurrent.futures.ProcessPoolExecutor(1, mp_context=context)
            self._pid = self._pool.submit(os.getpid).result()
        if self._knows is not fn:
            try:
                self._pool.submit(callable, fn).result()
            except (pickle.PicklingError, AttributeError, TypeError) as error:
                raise _not_importable(fn, error) from error
            self._knows = fn
        return self._pool


def _not_importable(fn: Callable, error: Exception) -> NotImportableError:
    return NotImportableError(f"a worker process cannot import {fn}: {how_to_import(fn)} ({error})")
