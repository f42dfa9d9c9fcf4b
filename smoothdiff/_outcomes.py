"""How calls of a host function end, each by itself or with all others."""

from collections.abc import Callable, Generator
from typing import Any, NamedTuple

# what may be raised and is a fault of one call; Ctrl-C is none
FAULTS = Exception, SystemExit


class AllHangError(RuntimeError):
    """Every worker of a pool is in a call that cannot be ended."""


class CallLostError(RuntimeError):
    """A call was lost through no fault of its own."""


class SuspectError(RuntimeError):
    """A call was with its worker when that died, and may or may not be why; the cause says how."""


class Outcome(NamedTuple):
    """How a call ended; a call is known by its sample, and None is the one call of a batch."""

    sample: int | None
    tries: int
    value: Any
    error: BaseException | None


class PoolLostError(Exception):
    """An executor takes no more calls; `samples` are those that may have brought it down."""

    def __init__(self, error: BaseException, samples: list[int | None]):
        super().__init__(f"{type(error).__name__}: {error}")
        self.samples = samples


Outcomes = Generator[Outcome, None, None]
# told of a sample and what the function returned for it
Late = Callable[[int | None, Any], None]
