"""Calls of a host function on the workers of a Dask cluster.

Dask is not imported: who has a client has imported it.
"""

import concurrent.futures
import os
import signal
import uuid
import weakref
from collections import OrderedDict
from typing import Any

import numpy as np

from smoothdiff._executors import AtOnce
from smoothdiff._host_samples import Samples
from smoothdiff._processes import Seconds

# bytes of an array that the workers get once and not with each call, and how many they keep
_LARGE, _KEPT = 1_000_000, 8


class OnDask(AtOnce):
    """Calls on the workers of a Dask cluster, to which large arrays are sent once."""

    def __init__(self, client: Any):
        # Dask takes calls of the same function with the same arguments for one call, unless they
        # are impure; then a call that failed would never be tried again
        super().__init__(client.get_executor(pure=False))
        self._client = client
        self._sent: OrderedDict[bytes, Any] = OrderedDict()
        self._keys: weakref.WeakKeyDictionary[Any, str] = weakref.WeakKeyDictionary()

    def _submit(self, fun: Any, samples: Samples, sample: int | None, timeout: Seconds) -> Any:
        args = (self._there(arg, samples) for arg in samples.arguments(sample))
        key = f"{getattr(fun, '__name__', 'call')}-{uuid.uuid4()}"
        future = self._executor.submit(fun, *args, key=key)
        self._keys[future] = key
        return future

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
            self._client.wait_for_workers(1)
            self._sent[name] = self._client.scatter(arg, broadcast=True)
        self._sent.move_to_end(name)
        while len(self._sent) > _KEPT:
            self._sent.popitem(last=False)
        return self._sent[name]

    def _workers(self, future: Any) -> list[str]:
        key = self._keys[future]
        return [worker for worker, keys in self._client.processing().items() if key in keys]

    def _begun(self, future: Any) -> bool:
        return bool(self._workers(future))

    def _result(self, future: Any, timeout: Seconds) -> Any:
        try:
            return super()._result(future, timeout)
        except concurrent.futures.CancelledError:
            self._sent.clear()  # it went with the workers that had it
            raise

    def _stop(self, future: Any) -> None:
        """Kills the worker; its nanny starts another one, and Dask makes its other calls again."""
        workers = self._workers(future)
        future.cancel()
        kill = lambda dask_worker: os.kill(dask_worker.pid, signal.SIGKILL)
        if workers:  # none would be all
            self._client.run(kill, workers=workers, nanny=True, on_error="ignore")
