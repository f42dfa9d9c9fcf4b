"""What is compiled quickly, and how: programs that run so short that compiling takes longer."""

import contextlib
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr

from smoothdiff._devices import default_platform, on_cpu, platform_of

# half of the time of compiling is saved, and a program takes two to three times as long
_UNOPTIMISED = {"xla_backend_optimization_level": 0}
# XLA's older, smaller code for fused operations, in one piece: another two thirds are saved
_OLDER = {"xla_cpu_use_fusion_emitters": False, "xla_cpu_parallel_codegen_split_count": 1}
# a program that reads and writes fewer numbers takes less than a millisecond, host functions apart
_SHORT = 100_000


def jit_quickly(fun: Callable, jit: Callable = jax.jit, **options: Any) -> Callable:
    """The function, jitted so that compiling takes little time where new arrays are on a CPU."""
    well = jit(fun, **options)
    quickly = functools.cache(lambda: jit(fun, compiler_options=_quickly(), **options))
    return lambda *args: (quickly() if default_platform() == "cpu" else well)(*args)


@functools.cache
def _quickly() -> dict[str, Any]:
    """The options of XLA's compiler, of which other versions may know fewer."""
    options = dict(_UNOPTIMISED)
    for name, value in _OLDER.items():
        with contextlib.suppress(jax.errors.JaxRuntimeError), on_cpu():
            jax.jit(lambda: 0, compiler_options={name: value})()
            options[name] = value
    return options


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
