"""Calls of a host function: faults that name their arguments, checks of results, what is kept.

All of this runs inside JAX's callback, where any call into JAX can hang: NumPy only, no JAX here.
"""

import concurrent.futures
import contextlib
import dataclasses
import logging
import os
import threading
import traceback
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from smoothdiff._casts import as_promised
from smoothdiff._executors import Engine
from smoothdiff._host_samples import BlackBoxError, Samples
from smoothdiff._outcomes import Outcome, Outcomes, PoolLostError
from smoothdiff._processes import NotImportableError
from smoothdiff._store import Found, Store

_log = logging.getLogger("smoothdiff")
_OURS = os.path.dirname(__file__), os.path.dirname(concurrent.futures.__file__)
# calls that an error shows of those that may have brought a pool down
_SHOWN = 4
_FIRST = (
    "(This call was to find what the function returns, so it cannot be a NaN: give `out`, as "
    "sd.black_box(fun, out=0.0, ...) for one number, or begin at another start)"
)


@dataclasses.dataclass(frozen=True, eq=False)
class HostFunction:
    """A host function and how it is called; the fields are the arguments of `black_box`."""

    fun: Callable[..., Any]
    # what it is called, and where and how often it is tried, says nothing of its values
    name: str = dataclasses.field(compare=False)
    batched: bool
    engine: Engine = dataclasses.field(compare=False)
    on_error: str
    on_nonfinite: str
    retries: int = dataclasses.field(compare=False)
    timeout: int | float | None = dataclasses.field(compare=False)
    store: Store | None = dataclasses.field(compare=False)

    def __call__(self, samples: Samples, outs: Sequence[np.ndarray], out_tree: Any) -> None:
        """Evaluates all samples and writes the results into `outs`, one row per sample."""
        if self.store is None:
            self._evaluate(samples, outs, out_tree)
        else:
            with self.store.calls():
                self._look_up(self.store, samples, outs, out_tree)

    def _look_up(
        self, store: Store, samples: Samples, outs: Sequence[np.ndarray], out_tree: Any
    ) -> None:
        """Evaluates those samples that are not in the store."""
        points = store.points(samples)
        known = self._fill(store.find(points), outs)
        if known.all():
            return
        # of samples that are the same point one is evaluated for all
        seen: dict[str, int] = {}
        first = np.array([seen.setdefault(point, i) for i, point in enumerate(points)])
        asked = ~known & (first == np.arange(len(points)))
        rest = samples.only(asked)
        rows = [np.empty((len(rest), *out.shape[1:]), out.dtype) for out in outs]
        self._evaluate(rest, rows, out_tree)
        same = ~known & ~asked
        for out, row in zip(outs, rows, strict=True):
            out[asked] = row
            out[same] = out[first[same]]

    def first(self, samples: Samples) -> Any:
        """What a call returns of which nothing is known yet, and which must not fail."""
        if self.store is None:
            return self._first(samples)
        with self.store.calls():
            (found,) = self.store.find(self.store.points(samples))
            with contextlib.suppress(ValueError):
                if found is not None:
                    value = found.tree(flat=False)
                    return jax.tree.map(lambda leaf: leaf[None], value) if self.batched else value
            return self._first(samples)

    def _first(self, samples: Samples) -> Any:
        unknown = lambda i, value: None
        with contextlib.closing(self._outcomes(samples, unknown)) as outcomes:
            (outcome,) = outcomes
        if outcome.error is not None:
            failure = self._failure(samples, outcome, outcome.error)
            if self.on_error == "nan":
                failure = _at_point(f"{failure}\n{_FIRST}")
            raise failure from outcome.error
        return outcome.value

    def accept(
        self,
        samples: Samples,
        i: int | None,
        value: Any,
        outs: Sequence[np.ndarray],
        out_tree: Any,
    ) -> None:
        """Writes what a call returned into its rows, if it is what was promised."""
        rows = self._promised(samples, i, value, outs, out_tree)
        good = self._keep(samples, i, rows, out_tree)
        for k in np.flatnonzero(~good):
            fault = self._fault(
                samples, int(k) if i is None else i, "returned a value that is not finite"
            )
            if self.on_nonfinite == "raise":
                raise _at_point(f'{fault}\n(on_nonfinite="nan" makes it a NaN instead)')
            _log.info("%s", fault)
            for row in rows:
                row[k] = np.nan
        for out, row in zip(outs, rows, strict=True):
            out[_rows(i)] = row

    def _promised(
        self, samples: Samples, i: int | None, value: Any, outs: Sequence[np.ndarray], out_tree: Any
    ) -> list[np.ndarray]:
        """What a call returned as arrays of the promised types, with one row for each sample."""
        try:
            leaves = out_tree.flatten_up_to(value)
            shapes = [out.shape if i is None else out.shape[1:] for out in outs]
            rows = [
                as_promised(leaf, out.dtype, shape)
                for leaf, out, shape in zip(leaves, outs, shapes, strict=True)
            ]
        except (TypeError, ValueError) as error:
            # A mistake in the program, not in a sample: never retried, never turned into NaN.
            what = "does not return what `out` promises, or what it returned at first"
            raise BlackBoxError(self._fault(samples, i, f"{what}: {error}")) from error
        return rows if i is None else [row[None] for row in rows]

    def _keep(
        self, samples: Samples, i: int | None, rows: Sequence[np.ndarray], out_tree: Any
    ) -> np.ndarray:
        """Stores the rows that are finite, and says which they are."""
        finite = [np.isfinite(row).all(axis=tuple(range(1, row.ndim))) for row in rows]
        good = np.all(finite, axis=0)
        if self.store is not None:
            for k in np.flatnonzero(good):
                at = int(k) if i is None else i
                self.store.put(samples, at, [row[k, ...] for row in rows], out_tree)
        return good

    def _fill(self, values: Sequence[Found | None], outs: Sequence[np.ndarray]) -> np.ndarray:
        """Writes the rows that are known, and says which they are."""
        known = np.zeros(len(values), bool)
        for i, found in enumerate(values):
            leaves = [] if found is None else found.leaves
            if [(v.dtype, v.shape) for v in leaves] == [(o.dtype, o.shape[1:]) for o in outs]:
                known[i] = True
                for out, leaf in zip(outs, leaves, strict=True):
                    out[i] = leaf
        return known

    def _evaluate(self, samples: Samples, outs: Sequence[np.ndarray], out_tree: Any) -> None:
        def late(i: int | None, value: Any) -> None:
            with contextlib.suppress(BlackBoxError):
                self._keep(samples, i, self._promised(samples, i, value, outs, out_tree), out_tree)

        with contextlib.closing(self._outcomes(samples, late)) as outcomes:
            for outcome in outcomes:
                if outcome.error is None:
                    self.accept(samples, outcome.sample, outcome.value, outs, out_tree)
                    continue
                failure = self._failure(samples, outcome, outcome.error)
                if self.on_error == "raise":
                    raise failure from outcome.error
                _log.info("%s", failure)
                for out in outs:
                    out[_rows(outcome.sample)] = np.nan

    def _outcomes(self, samples: Samples, late: Callable[[int | None, Any], None]) -> Outcomes:
        which = [None] if self.batched else range(len(samples))
        # threads cannot wait longer, so a longer timeout is no limit
        endless = self.timeout is None or self.timeout >= threading.TIMEOUT_MAX
        rest = self.retries, None if endless else self.timeout, late
        try:
            yield from self.engine.outcomes(self.fun, samples, which, *rest)
        except PoolLostError as lost:
            raise self._lost(samples, lost) from lost.__cause__

    def _failure(self, samples: Samples, outcome: Outcome, error: BaseException) -> BlackBoxError:
        again = f" (tried {outcome.tries} times)" if outcome.tries > 1 else ""
        what = f"raised {type(error).__name__}: {error}{again}"
        return _at_point(f"{self._fault(samples, outcome.sample, what)}\n\n{_trace(error)}")

    def _lost(self, samples: Samples, lost: PoolLostError) -> BlackBoxError:
        """No call can be made anymore; nobody knows which one brought that about."""
        broken = lost.__cause__
        text = f"black box {self.name!r}: "
        if not isinstance(broken, NotImportableError):
            text += "the executor takes no more calls, make a new one. "
        text += str(lost)
        if isinstance(broken, concurrent.futures.BrokenExecutor):
            text += (
                "\n(A pool of processes breaks when a worker crashes or runs out of memory, or "
                "when it cannot import the function from its module. sd.Processes(4) replaces such "
                "workers.)"
            )
        if lost.samples:
            calls = "\n  ".join(self._call(samples, i) for i in lost.samples[:_SHOWN])
            text += f"\nThe first calls that had not ended were\n  {calls}"
        return BlackBoxError(text)

    def _fault(self, samples: Samples, i: int | None, what: str) -> str:
        """Says what went wrong where, and with which arguments."""
        size = len(samples)
        where = f", batch of {size}" if i is None else f", sample {i} of {size}" if size > 1 else ""
        return f"black box {self.name!r}{where}: {what}\n  {self._call(samples, i)}"

    def _call(self, samples: Samples, i: int | None) -> str:
        with np.printoptions(threshold=20, edgeitems=3, precision=8):
            call = f"{self.name}({', '.join(map(repr, samples.arguments(i)))})"
        return call if len(call) <= 2000 else f"{call[:2000]} ..."


def _at_point(text: str) -> BlackBoxError:
    error = BlackBoxError(text)
    error.at_point = True
    return error


def _rows(i: int | None) -> slice:
    return slice(None) if i is None else slice(i, i + 1)


def _trace(error: BaseException) -> str:
    """The traceback as text, without the frames of ours and of pools that it begins with."""
    trace = error.__traceback__
    while trace is not None and trace.tb_frame.f_code.co_filename.startswith(_OURS):
        trace = trace.tb_next
    return "".join(traceback.format_exception(type(error), error, trace))
