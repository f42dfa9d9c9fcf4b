"""Which programs are compiled quickly: those that run so short that compiling takes longer."""

import math
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr

from smoothdiff._devices import default_platform, platform_of

# half of the time of compiling is saved, and a program takes two to three times as long
QUICKLY = {"xla_backend_optimization_level": 0}
# a program that reads and writes fewer numbers takes less than a millisecond, host functions apart
_SHORT = 100_000


def is_short(program: ClosedJaxpr, times: int = 1, device: Any = None) -> bool:
    """Whether a program is short on the CPU, so many times at once; with a loop it never is.

    It runs on a device that is given, or where new arrays are.
    """
    platform = default_platform() if device is None else platform_of(device)
    return platform == "cpu" and times * _numbers(program.jaxpr) < _SHORT


def _numbers(jaxpr: Jaxpr) -> float:
    """How many numbers its operations read and write, infinite with a loop."""
    total = 0.0
    for equation in jaxpr.eqns:
        if equation.primitive.name in ("while", "scan"):
            return math.inf
        variables = *equation.invars, *equation.outvars
        total += sum(math.prod(getattr(v.aval, "shape", ())) for v in variables)
        parts = jax.tree.leaves(equation.params, is_leaf=lambda p: isinstance(p, _INNER))
        inner = [p for p in parts if isinstance(p, _INNER)]
        total += sum(_numbers(p.jaxpr if isinstance(p, ClosedJaxpr) else p) for p in inner)
    return total


_INNER = Jaxpr, ClosedJaxpr
