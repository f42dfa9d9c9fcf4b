"""Calls of a host function, one per sample or one per batch: executors, faults, checks of results.

All of this runs inside JAX's callback, where any call into JAX can hang: NumPy only, no JAX here,
but for asking an array whether it is there.
"""

import collections
import concurrent.futures
import contextlib
import dataclasses
import logging
import math
import time
import traceback
from collections.abc import Callable, Generator, Sequence
from typing import Any, NamedTuple

import numpy as np

from smoothdiff._casts import as_promised

_log = logging.getLogger("smoothdiff")


class BlackBoxError(RuntimeError):
    """A host function failed. The message names it, its arguments and the original error.

    A `smoothdiff.black_box` raises it; it is what `smoothdiff.minimise` reports in its
    `MinimiseError`. Out of a `jax.jit` of your own comes an error of JAX's, which has the same
    message in its text.
    """


def wait_for(leaves: Sequence[Any], name: str, seconds: float = 60.0) -> None:
    """Waits until JAX has handed over the arguments; raises where it seems that it never will.

    Args:
        leaves: What a callback was given. JAX copies arrays of more than 100 kB by a thread of its
            pool. If all of them are busy with callbacks, as the only one of a process on one core
            may be, `numpy.asarray` would wait forever (jax-ml/jax #25861).
        name: Of the host function.
        seconds: How long to wait at most.
    """
    end = time.monotonic() + seconds
    while not all(getattr(leaf, "is_ready", lambda: True)() for leaf in leaves):
        if time.monotonic() > end:
            raise BlackBoxError(
                f"{name}: JAX did not hand over the arguments within {seconds:g} s. Usually that "
                "is because the process has one core, so that JAX has one thread, which cannot "
                "copy large arguments while it waits for a host function: set the environment "
                "variable NPROC=2 before Python starts"
            )
        time.sleep(1e-4)


class Samples:
    """The arguments of a batch of calls: a pytree of arrays that begin with the same batch axes."""

    def __init__(self, leaves: Sequence[Any], ndims: Sequence[int], tree: Any):
        """Takes leaves whose batch axes, before the `ndims` of their own, may have size 1."""
        arrays = [np.asarray(leaf) for leaf in leaves]
        lead = arrays[0].ndim - ndims[0] if arrays else 0
        self.batch_shape = np.broadcast_shapes(*(array.shape[:lead] for array in arrays))
        self._arrays = [
            np.broadcast_to(array, self.batch_shape + array.shape[lead:]) for array in arrays
        ]
        self._tree = tree

    def __len__(self) -> int:
        return math.prod(self.batch_shape)

    def one(self, i: int) -> tuple:
        """The arguments of sample `i`."""
        index = (*np.unravel_index(i, self.batch_shape), ...)
        return self._tree.unflatten([array[index] for array in self._arrays])

    def all(self) -> tuple:
        """The arguments of all samples, with one leading axis."""
        lead = len(self.batch_shape)
        return self._tree.unflatten(
            [array.reshape(len(self), *array.shape[lead:]) for array in self._arrays]
        )


@dataclasses.dataclass(frozen=True)
class _Direct:
    """What a future is to an executor, without one: the call is made when its result is due."""

    fun: Callable[..., Any]
    args: tuple

    def result(self, timeout: None) -> Any:
        del timeout  # needs an executor
        return self.fun(*self.args)

    def done(self) -> bool:
        return True

    def cancel(self) -> bool:
        return True


class _Outcome(NamedTuple):
    """How a call ended; a call is known by its sample, and None is the one call of a batch."""

    sample: int | None
    tries: int
    value: Any
    error: Exception | None


@dataclasses.dataclass(frozen=True, eq=False)
class HostFunction:
    """A host function and how it is called; the fields are the arguments of `black_box`."""

    fun: Callable[..., Any]
    name: str
    batched: bool
    # where and how often it is tried says nothing of its values
    executor: concurrent.futures.Executor | None = dataclasses.field(compare=False)
    on_error: str
    on_nonfinite: str
    retries: int = dataclasses.field(compare=False)
    timeout: int | float | None = dataclasses.field(compare=False)

    def __call__(self, samples: Samples, outs: Sequence[np.ndarray], out_tree: Any) -> None:
        """Evaluates all samples and writes the results into `outs`, one row per sample."""
        with contextlib.closing(self._outcomes(samples)) as outcomes:
            for outcome in outcomes:
                if outcome.error is None:
                    self.store(samples, outcome.sample, outcome.value, outs, out_tree)
                    continue
                failure = self._failure(samples, outcome, outcome.error)
                if self.on_error == "raise":
                    raise failure from outcome.error
                _log.info("%s", failure)
                for out in outs:
                    out[_rows(outcome.sample)] = np.nan

    def first(self, samples: Samples) -> Any:
        """What a call returns of which nothing is known yet, and which must not fail."""
        with contextlib.closing(self._outcomes(samples)) as outcomes:
            (outcome,) = outcomes
        if outcome.error is not None:
            raise self._failure(samples, outcome, outcome.error) from outcome.error
        return outcome.value

    def _outcomes(self, samples: Samples) -> Generator[_Outcome, None, None]:
        """What each call returned or raised.

        Calls are submitted together and awaited in order. A failed one goes to the end of the
        line, as it does in an executor's queue: so what is awaited next is next to run, and a
        timeout does not count the wait for a worker, unless others use the executor too.
        """
        calls = [None] if self.batched else range(len(samples))
        queue = collections.deque()
        try:
            for i in calls:
                queue.append((i, 1, self._submit(samples, i)))
            while queue:
                i, tries, future = queue[0]
                try:
                    value = self._result(future)
                except concurrent.futures.BrokenExecutor as error:
                    raise self._broken(error) from error
                except Exception as error:
                    if tries <= self.retries:
                        queue.append((i, tries + 1, self._submit(samples, i)))
                    else:
                        yield _Outcome(i, tries, None, error)
                else:
                    yield _Outcome(i, tries, value, None)
                queue.popleft()
        finally:
            for _, _, future in queue:
                future.cancel()

    def _submit(self, samples: Samples, i: int | None) -> Any:
        args = samples.all() if i is None else samples.one(i)
        if self.executor is None:
            return _Direct(self.fun, args)
        try:
            return self.executor.submit(self.fun, *args)
        except Exception as error:
            raise self._broken(error) from error

    def _result(self, future: Any) -> Any:
        try:
            return future.result(self.timeout)
        except TimeoutError:
            if future.done():  # raised by the function itself
                raise
            future.cancel()
            raise TimeoutError(f"no result within {self.timeout} s") from None

    def _failure(self, samples: Samples, outcome: _Outcome, error: Exception) -> BlackBoxError:
        again = f" (tried {outcome.tries} times)" if outcome.tries > 1 else ""
        what = f"raised {type(error).__name__}: {error}{again}"
        return BlackBoxError(f"{self._fault(samples, outcome.sample, what)}\n\n{_trace(error)}")

    def store(
        self,
        samples: Samples,
        i: int | None,
        value: Any,
        outs: Sequence[np.ndarray],
        out_tree: Any,
    ) -> None:
        """Writes what a call returned into its rows, if it is what was promised."""
        rows = _rows(i)
        try:
            leaves = out_tree.flatten_up_to(value)
            for leaf, out in zip(leaves, outs, strict=True):
                shape = out.shape if i is None else out.shape[1:]
                out[rows] = as_promised(leaf, out.dtype, shape)
        except (TypeError, ValueError) as error:
            # A mistake in the program, not in a sample: never retried, never turned into NaN.
            what = "does not return what `out` promises, or what it returned at first"
            raise BlackBoxError(self._fault(samples, i, f"{what}: {error}")) from error

        finite = [np.isfinite(out[rows]).all(axis=tuple(range(1, out.ndim))) for out in outs]
        for row in np.flatnonzero(~np.all(finite, axis=0)):
            bad = int(row) if i is None else i
            fault = self._fault(samples, bad, "returned a value that is not finite")
            if self.on_nonfinite == "raise":
                raise BlackBoxError(f'{fault}\n(on_nonfinite="nan" makes it a NaN instead)')
            _log.info("%s", fault)
            for out in outs:
                out[bad] = np.nan

    def _fault(self, samples: Samples, i: int | None, what: str) -> str:
        """Says what went wrong where, and with which arguments."""
        size = len(samples)
        where = f", batch of {size}" if i is None else f", sample {i} of {size}" if size > 1 else ""
        args = samples.all() if i is None else samples.one(i)
        with np.printoptions(threshold=20, edgeitems=3, precision=8):
            call = f"{self.name}({', '.join(map(repr, args))})"
        if len(call) > 2000:
            call = f"{call[:2000]} ..."
        return f"black box {self.name!r}{where}: {what}\n  {call}"

    def _broken(self, error: Exception) -> BlackBoxError:
        return BlackBoxError(
            f"black box {self.name!r}: the executor takes no more calls, make a new one. "
            f"{type(error).__name__}: {error}\n(A pool of processes breaks when a worker crashes, "
            "runs out of memory, or cannot import the function from its module.)"
        )


def _trace(error: Exception) -> str:
    """The traceback as text, without the frames of this file that it begins with."""
    trace = error.__traceback__
    while trace is not None and trace.tb_frame.f_code.co_filename == __file__:
        trace = trace.tb_next
    return "".join(traceback.format_exception(type(error), error, trace))


def _rows(i: int | None) -> slice:
    return slice(None) if i is None else slice(i, i + 1)
