"""How calls of a host function are made by an executor, several at once.

Runs inside JAX's callbacks, so no JAX here.
"""

import concurrent.futures
import dataclasses
import functools
import itertools
import queue
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from smoothdiff._ctrl_c import raise_if_pressed
from smoothdiff._host_samples import Samples
from smoothdiff._in_turn import InTurn
from smoothdiff._outcomes import (
    FAULTS,
    AllHangError,
    CallLostError,
    Late,
    Outcome,
    Outcomes,
    PoolLostError,
    SuspectError,
)
from smoothdiff._processes import NotImportableError, Processes, Seconds, how_to_import

# after these no call can be made
_ENDS = concurrent.futures.BrokenExecutor, AllHangError, NotImportableError
# how often a call that was lost is made again
_LOSSES = 5
# seconds for calls to end that run when others have failed; a later value is kept if all lives on
_PROMPT = 2.0


@dataclasses.dataclass
class _Call:
    sample: int | None
    tries: int
    losses: int
    # whether no other one of the batch is under way
    alone: bool = False
    future: Any = None
    # since when it is the oldest of those that have not come, and who has it
    oldest_since: float | None = None
    place: Any = None


class AtOnce:
    """Calls that an executor makes, several at once."""

    # whether the executor itself ends calls that take too long
    keeps_time = False
    # seconds of waiting after which it is looked at
    glances_every = 1.0

    def __init__(self, executor: Any):
        self._executor = executor
        self._hung: list[Any] = []
        self._sendable: Callable[..., Any] | None = None  # that processes can have

    def outcomes(
        self,
        fun: Callable[..., Any],
        samples: Samples,
        which: Iterable[int | None],
        retries: int,
        timeout: Seconds,
        late: Late,
    ) -> Outcomes:
        """What each call returned or raised, as they come.

        All are submitted together, so that no worker waits. A call that may have died of another
        one is made again alone, after all others.

        Args:
            fun: the host function.
            samples: its arguments.
            which: the samples to call it for, None for all in one call.
            retries: how often a call that failed is made again.
            timeout: seconds that a call may take.
            late: told of what comes when nobody waits for it anymore, in another thread.

        Raises:
            PoolLostError: the executor takes no more calls.
        """
        which = list(which)
        self._check_sent(fun, which)
        came: queue.SimpleQueue[int] = queue.SimpleQueue()
        # those that have not come, in the order in which they began
        calls: dict[int, _Call] = {}
        tickets, patience = itertools.count(), None if self.keeps_time else timeout
        suspects: deque[_Call] = deque()

        def submit(
            which: list[int | None], tries: int = 1, losses: int = 0, alone: bool = False
        ) -> None:
            futures = self._submit(fun, samples, which, timeout)
            for sample in which:
                ticket = next(tickets)
                calls[ticket] = _Call(sample, tries, losses, alone)
                try:
                    future = next(futures)
                except RuntimeError as error:  # it was shut down, or is broken
                    raise PoolLostError(error, [call.sample for call in calls.values()]) from error
                calls[ticket].future = future
                future.add_done_callback(lambda _, ticket=ticket: came.put(ticket))

        def give_up(calls: Iterable[_Call], wait: float) -> None:
            of = {call.future: call.sample for call in calls if call.future is not None}
            left = self._go_on(list(of))
            concurrent.futures.wait(left, wait)
            for future in left:
                future.add_done_callback(functools.partial(_tell, late, of[future]))

        try:
            submit(which)
            while calls or suspects:
                if not calls:
                    suspect = suspects.popleft()
                    submit([suspect.sample], suspect.tries, suspect.losses, alone=True)
                ticket = self._awaited(came, calls, patience)
                call = calls[ticket]
                try:
                    value, error = self._result(call.future, timeout), None
                except FAULTS as fault:
                    if isinstance(fault, _ENDS) and not self._lives_on(fault):
                        raise
                    value, error = None, fault
                    give_up([call], 0)
                del calls[ticket]
                if isinstance(error, CallLostError) and call.losses < _LOSSES:
                    submit([call.sample], call.tries, call.losses + 1, call.alone)
                elif isinstance(error, SuspectError) and not call.alone:
                    suspects.append(call)
                elif error is not None and call.tries <= retries:
                    submit([call.sample], call.tries + 1)
                else:
                    cause = error.__cause__ if isinstance(error, SuspectError) else error
                    yield Outcome(call.sample, call.tries, value, cause)
        except _ENDS as error:
            left = [call.sample for call in (*calls.values(), *suspects)]
            raise PoolLostError(error, left) from error
        finally:
            give_up(calls.values(), _PROMPT)

    def _check_sent(self, fun: Callable[..., Any], which: list[int | None]) -> None:
        """Raises PoolLostError for a function that processes cannot have: no call will do."""
        if (
            type(self._executor) is not concurrent.futures.ProcessPoolExecutor
            or fun is self._sendable
        ):
            return
        from multiprocessing.reduction import ForkingPickler  # not with the package

        try:
            ForkingPickler.dumps(fun)
        except Exception as error:
            lost = NotImportableError(
                f"{fun!r} cannot be sent to processes: {how_to_import(fun)} ({error})"
            )
            raise PoolLostError(lost, which) from lost
        self._sendable = fun

    def _awaited(self, came: queue.SimpleQueue, calls: dict[int, _Call], timeout: Seconds) -> int:
        """The ticket of the next call that came, or took longer than the timeout.

        The clock runs for the oldest call alone. Executors begin calls in order, so it does not
        count the wait for a worker, unless others use the executor too. It starts anew for a call
        that has lost its worker to another call.
        """
        while True:
            oldest, call = next(iter(calls.items()))
            now = time.monotonic()
            if call.oldest_since is None:
                call.oldest_since = now
            left = None if timeout is None else max(call.oldest_since + timeout - now, 0)
            wait = self.glances_every if left is None else min(left, self.glances_every)
            try:
                ticket = came.get(timeout=wait)
            except queue.Empty:
                self._glance()
                if left is None:
                    continue
                place, before = self._place(call.future), call.place
                call.place = place
                if place is None or before not in (None, place):
                    call.oldest_since = None
                elif time.monotonic() >= now + left:
                    return oldest
            else:
                if ticket in calls:  # else it was given up before
                    return ticket

    def _lives_on(self, fault: BaseException) -> bool:
        """Whether it was the function that raised what a broken executor raises."""
        if not isinstance(fault, concurrent.futures.BrokenExecutor):
            return False
        try:
            self._executor.submit(int).cancel()
        except RuntimeError:
            return False
        return True

    def _glance(self) -> None:
        """Sees that the executor has what it needs, and that all is wanted, while nothing comes."""
        raise_if_pressed()

    def _submit(
        self, fun: Any, samples: Samples, which: list[int | None], timeout: Seconds
    ) -> Iterator[Any]:
        """The futures of calls."""
        del timeout
        return (self._executor.submit(fun, *samples.arguments(sample)) for sample in which)

    def _place(self, future: Any) -> Any:
        """The worker that has a call, as far as that is known; None without one."""
        del future
        return "any"

    def _result(self, future: Any, timeout: Seconds) -> Any:
        if future.done():
            return future.result()
        self._stop(future)
        raise TimeoutError(f"no result within {timeout} s")

    def _go_on(self, futures: list[Any]) -> list[Any]:
        """Cancels calls that have not begun; the others."""
        return [future for future in futures if not future.cancel()]

    def _stop(self, future: Any) -> None:
        """Ends a call that takes too long; threads, and processes of others, cannot be ended."""
        self._hung = [hung for hung in self._hung if not hung.done()]
        if future.cancel() and self._hung:
            raise AllHangError(
                "no worker is left, each is in a call that took longer than the timeout and cannot "
                "be ended; sd.Processes(4) replaces workers that hang"
            )
        self._hung.append(future)


class Replaced(AtOnce):
    """Calls in worker processes that are replaced when they die or hang."""

    keeps_time = True

    def _submit(
        self, fun: Any, samples: Samples, which: list[int | None], timeout: Seconds
    ) -> Iterator[Any]:
        begin = self._executor.submit_within
        return (begin(timeout, fun, *samples.arguments(sample)) for sample in which)


Engine = InTurn | AtOnce


def engine(executor: Any) -> Engine:
    """How an executor is used.

    Raises:
        TypeError: it is none.
    """
    if executor is None:
        return InTurn()
    if type(executor).__module__.startswith("distributed."):
        from smoothdiff._dask import OnDask

        # a client, or what its get_executor() gives
        return OnDask(getattr(executor, "_client", executor))
    if isinstance(executor, Processes):
        return Replaced(executor)
    if isinstance(executor, concurrent.futures.Executor):
        return AtOnce(executor)
    raise TypeError(
        "executor must be a concurrent.futures.Executor, such as ThreadPoolExecutor(4) or "
        f"sd.Processes(4), or a distributed.Client of Dask, not {executor!r}"
    )


def _tell(late: Late, sample: int | None, future: Any) -> None:
    if not future.cancelled() and future.exception() is None:
        late(sample, future.result())
