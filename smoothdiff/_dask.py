"""Calls of a host function on the workers of a Dask cluster.

Dask is not imported: who has a client has imported it.
"""

import concurrent.futures
import contextlib
import logging
import os
import signal
import time
import uuid
from collections import OrderedDict
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from smoothdiff._executors import AtOnce
from smoothdiff._host_samples import Samples
from smoothdiff._outcomes import AllHangError, CallLostError, SuspectError
from smoothdiff._processes import Seconds

# bytes of an array that the workers get once and not with each call, and how many they keep
_LARGE, _KEPT = 1_000_000, 8
# bytes of arguments in a message, before large arrays are taken out
_MESSAGE = 8_000_000
# seconds without a worker after which that is said, between two looks at a cluster, and between two
# while it is told something
_LONELY, _GLANCE, _MOMENT = 60.0, 2.0, 0.01


_log = logging.getLogger("smoothdiff")


class _Awaited(concurrent.futures.Future):
    """A call that Dask makes; what comes is taken in Dask's own loop."""

    def __init__(self, there: Any):
        super().__init__()
        self.key = there.key
        self.there = there

    def cancel(self) -> bool:
        """Tells Dask, too."""
        cancelled = super().cancel()
        if cancelled and self.there.status != "cancelled":
            self.there.cancel()
        return cancelled

    async def settle(self) -> None:
        """Takes the value, or whatever a worker raised, unless it was cancelled meanwhile."""
        value, error = None, None
        try:
            value = await self.there
        except BaseException as raised:  # a worker may raise anything
            error = raised
        if self.there.status == "cancelled":
            self.cancel()
            return
        with contextlib.suppress(concurrent.futures.InvalidStateError):
            if error is None:
                self.set_result(value)
            else:
                self.set_exception(error)


class OnDask(AtOnce):
    """Calls on the workers of a Dask cluster, to which large arrays are sent once."""

    glances_every = _GLANCE

    def __init__(self, client: Any):
        super().__init__(client)
        self._client = client
        self._sent: OrderedDict[bytes, Any] = OrderedDict()
        # of calls whose workers could not be ended
        self._hung_keys: set[str] = set()
        self._no_workers_since: float | None = None

    def _submit(
        self, fun: Any, samples: Samples, which: list[int | None], timeout: Seconds
    ) -> Iterator[_Awaited]:
        """Many in a message; one for each would take most of the time of a short call."""
        del timeout
        name = getattr(fun, "__name__", "call")
        for some in self._messages([samples.arguments(sample) for sample in which]):
            there = [[self._there(arg, samples) for arg in args] for args in some]
            columns = list(zip(*there, strict=True))
            keys = [f"{name}-{uuid.uuid4()}" for _ in some]
            # Dask takes calls of the same function with the same arguments for one call, unless
            # they are impure; then a call that failed would never be tried again
            if columns:
                futures = self._client.map(fun, *columns, key=keys, pure=False)
            else:
                futures = [self._client.submit(fun, key=key, pure=False) for key in keys]
            calls = [_Awaited(future) for future in futures]
            for call in calls:
                self._client.loop.add_callback(call.settle)
            yield from calls

    def _messages(self, calls: list[Any]) -> Iterator[list[Any]]:
        """The calls, as many at a time as make no large message."""
        size = sum(part.nbytes for part in jax.tree.leaves(calls[:1]) if hasattr(part, "nbytes"))
        count = max(1, _MESSAGE // max(1, size))
        return (calls[i : i + count] for i in range(0, len(calls), count))

    def _there(self, arg: Any, samples: Samples) -> Any:
        """An argument in which large arrays are those that the workers have."""
        if type(arg) in (list, tuple):
            return type(arg)(self._there(part, samples) for part in arg)
        if type(arg) is dict:
            return {key: self._there(part, samples) for key, part in arg.items()}
        if not isinstance(arg, np.ndarray) or arg.nbytes < _LARGE:
            return arg
        name = samples.digest(arg)
        if name not in self._sent:
            self._sent[name] = self._scattered(arg)
        self._sent.move_to_end(name)
        while len(self._sent) > _KEPT:
            self._sent.popitem(last=False)
        return self._sent[name]

    def _scattered(self, array: np.ndarray) -> Any:
        while True:
            with contextlib.suppress(TimeoutError):
                self._client.wait_for_workers(1, timeout=_GLANCE)
                return self._client.scatter(array, broadcast=True)
            self._glance()

    def _glance(self) -> None:
        """Asks for the workers that a cluster has given up, and says so where there are none.

        A cluster of Dask's forgets a worker that is not back 15 s after it died, or that has died
        again by then, and begins no other one: in the end it would have none, and calls would wait
        for ever.
        """
        super()._glance()
        cluster = self._client.cluster
        wanted = getattr(cluster, "worker_spec", ())
        if len(getattr(cluster, "workers", wanted)) < len(wanted):
            cluster.scale(len(wanted))
        now = time.monotonic()
        if self._client.nthreads():
            self._no_workers_since = None
        elif self._no_workers_since is None:
            self._no_workers_since = now
        elif now - self._no_workers_since > _LONELY:
            self._no_workers_since = float("inf")  # said once
            _log.warning(
                "the Dask cluster %s has had no worker for a minute; calls wait until it has one",
                self._client.scheduler_info().get("address", ""),
            )

    def _workers(self, future: _Awaited) -> list[str]:
        return [name for name, keys in self._client.processing().items() if future.key in keys]

    def _place(self, future: Any) -> str | None:
        return next(iter(self._workers(future)), None)

    def _go_on(self, futures: list[Any]) -> list[Any]:
        """Cancels calls that no worker has; Dask would forget those that run, too."""
        begun: set[str] = set()
        if not all(future.done() for future in futures):
            with contextlib.suppress(Exception):  # the client may be why nothing goes on
                begun.update(*self._client.processing().values())
                states = list(self._client.futures.items())
                begun.update(key for key, state in states if state.status == "finished")
        runs = [future for future in futures if not future.done() and future.key in begun]
        return [future for future in futures if future in runs or not future.cancel()]

    def _result(self, future: Any, timeout: Seconds) -> Any:
        try:
            return super()._result(future, timeout)
        except concurrent.futures.CancelledError as error:
            self._sent.clear()  # it went with the workers that had it
            raise CallLostError("the workers that had its arguments died") from error
        except Exception as error:
            # Dask counts the deaths of a worker against all calls that it was given, those that
            # only wait there, too
            if type(error).__name__ == "KilledWorker":
                raise SuspectError("its workers died") from error
            raise

    def _stop(self, future: Any) -> None:
        """Kills the worker; its nanny starts another one, and Dask makes its other calls again."""
        workers = self._workers(future)
        future.cancel()
        if not workers:  # and to name none would name all
            return
        # killed before the scheduler knows of that, the worker would hand the call to another one
        end = time.monotonic() + _GLANCE
        while self._workers(future) and time.monotonic() < end:
            time.sleep(_MOMENT)
        kill = lambda dask_worker: os.kill(dask_worker.pid, signal.SIGKILL)
        if not self._client.run(kill, workers=workers, nanny=True, on_error="ignore"):
            self._raise_if_all_hang()
            self._hung_keys.add(future.key)

    def _raise_if_all_hang(self) -> None:
        keys = self._hung_keys
        count = lambda dask_worker: len(keys.intersection(dask_worker.active_threads.values()))
        hung, threads = self._client.run(count, on_error="ignore"), self._client.nthreads()
        if all(hung.get(worker, 0) >= count for worker, count in threads.items()):
            raise AllHangError(
                "no worker is left, each is in a call that took longer than the timeout, and has "
                "no nanny that could begin another one: leave out --no-nanny, or processes=False"
            )
