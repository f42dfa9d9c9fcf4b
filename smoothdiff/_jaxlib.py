"""A warning where the jaxlib that is installed can hang."""

import importlib.util
import warnings

import jax
from jaxlib.version import __version__ as _JAXLIB

_FIRST, _LAST = (0, 10, 0), (0, 11, 0)
# where plugins for GPUs are, and what TPUs need
_ACCELERATORS = "jax_plugins", "libtpu"


def warn_if_it_can_hang() -> None:
    """Warns of a jaxlib that can hang, if JAX will run on a CPU."""
    version = tuple(int(part) for part in _JAXLIB.split(".")[:3] if part.isdigit())
    if _FIRST <= version <= _LAST and _on_cpu():
        warnings.warn(
            f"jaxlib {_JAXLIB} can hang on CPUs, in programs with several independent calls of "
            "LAPACK over a large batch, such as jnp.linalg.solve under jax.vmap. smoothdiff's own "
            "programs have one at a time; if yours have more, install jaxlib>=0.11.1 (Python 3.12 "
            'and later) or "jax<0.10"',
            RuntimeWarning,
            stacklevel=3,
        )


def _on_cpu() -> bool:
    """Whether JAX will run on a CPU, as far as can be told without starting it."""
    platforms: str | None = getattr(jax.config, "jax_platforms")  # noqa: B009, types know no flag
    if platforms:
        return platforms.split(",")[0] == "cpu"
    return not any(map(importlib.util.find_spec, _ACCELERATORS))
