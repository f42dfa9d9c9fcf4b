"""Seconds of calls that are compared: they run in turn, so that other work falls on all of them."""

import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import numpy as np


def in_turns(calls: Mapping[str, Callable[[int], Any]], turns: int) -> dict[str, np.ndarray]:
    """Seconds of each call in each turn, (turns,) each.

    Args:
        calls: By name, each a function of the number of the turn. The first turn compiles and is
            not in what is returned.
        turns: How often each is timed. Every other turn they run in reverse order.
    """
    seconds = {name: np.zeros(turns + 1) for name in calls}
    for turn in range(turns + 1):
        for name in list(calls)[:: -1 if turn % 2 else 1]:
            began = time.perf_counter()
            jax.block_until_ready(calls[name](turn))
            seconds[name][turn] = time.perf_counter() - began
    return {name: each[1:] for name, each in seconds.items()}


def compiled(
    functions: Mapping[str, Callable], inputs: Callable[[int], tuple], turns: int
) -> dict[str, np.ndarray]:
    """The same of functions that are compiled first, and see the same inputs in a turn."""

    def call(function: Callable, turn: int) -> Any:
        return function(*inputs(turn))

    return in_turns({name: partial(call, jax.jit(f)) for name, f in functions.items()}, turns)
