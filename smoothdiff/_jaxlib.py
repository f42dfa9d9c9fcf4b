"""A warning where the jaxlib that is installed can hang."""

import importlib.util
import os
import warnings

import jax
from jaxlib.version import __version__ as _JAXLIB

_FIRST, _LAST = (0, 10, 0), (0, 11, 0)
# where plugins for GPUs are, and what TPUs need
_ACCELERATORS = "jax_plugins", "libtpu"
# A thread of XLA's that makes such a call waits until others have done the work. Of so many threads
# some are left for that, as hardly a program has as many such calls at once; and what to ask for.
_ENOUGH, _MANY = 16, 32


def warn_if_it_can_hang() -> None:
    """Warns of a jaxlib that can hang, if JAX will run on a CPU with few threads."""
    if _can_hang() and _threads() < _ENOUGH:
        warnings.warn(
            f"jaxlib {_JAXLIB} can hang on CPUs, in programs with several independent calls of "
            "LAPACK over a large batch, such as jnp.linalg.solve under jax.vmap. smoothdiff's own "
            "programs have one at a time; if yours have more, give XLA threads enough: set "
            f"NPROC={_MANY} in the environment before Python starts, which ends this warning. Or "
            'install jaxlib>=0.11.1 (Python 3.12 and later) or "jax<0.10"',
            RuntimeWarning,
            stacklevel=3,
        )


def take_threads() -> None:
    """What the warning advises, for programs of this repository, before JAX has started."""
    if _can_hang():
        os.environ.setdefault("NPROC", str(_MANY))


def _can_hang() -> bool:
    """Whether it is such a version, and JAX will run on a CPU."""
    version = tuple(int(part) for part in _JAXLIB.split(".")[:3] if part.isdigit())
    return _FIRST <= version <= _LAST and _on_cpu()


def _threads() -> int:
    """How many XLA will have."""
    asked = os.environ.get("NPROC", "")
    if asked.isdigit():
        return int(asked)
    there = getattr(os, "sched_getaffinity", None)
    return len(there(0)) if there else os.cpu_count() or 1


def _on_cpu() -> bool:
    """Whether JAX will run on a CPU, as far as can be told without starting it."""
    platforms: str | None = getattr(jax.config, "jax_platforms")  # noqa: B009, types know no flag
    if platforms:
        return platforms.split(",")[0] == "cpu"
    return not any(map(importlib.util.find_spec, _ACCELERATORS))
