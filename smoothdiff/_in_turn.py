"""How calls of a host function are made where there is no executor: one after another.

Runs inside JAX's callbacks, so no JAX here.
"""

from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

from smoothdiff._ctrl_c import evaluating, raise_if_pressed
from smoothdiff._host_samples import Samples
from smoothdiff._outcomes import FAULTS, Late, Outcome, Outcomes
from smoothdiff._processes import Seconds


class InTurn:
    """Calls in the thread that waits for them; a failed one goes to the end of the line."""

    def outcomes(
        self,
        fun: Callable[..., Any],
        samples: Samples,
        which: Iterable[int | None],
        retries: int,
        timeout: Seconds,
        late: Late,
    ) -> Outcomes:
        """As for `_executors.AtOnce`."""
        del timeout, late  # for executors
        line = deque((sample, 1) for sample in which)
        while line:
            raise_if_pressed()
            sample, tries = line.popleft()
            try:
                with evaluating():
                    value = fun(*samples.arguments(sample))
                outcome = Outcome(sample, tries, value, None)
            except FAULTS as error:
                if tries <= retries:
                    line.append((sample, tries + 1))
                    continue
                outcome = Outcome(sample, tries, None, error)
            yield outcome
