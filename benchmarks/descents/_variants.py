"""Variants of filtered Adam to tune over: each rate of decay with each filter.

Rates of decay are tied as in Chang et al. 2024, section 5.1: 1 - b1 = sqrt(1 - b2).
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import optax

import smoothdiff as sd
from benchmarks.descents._descent import Optimiser, Rate

EPS = 1e-12  # less than any gradient here, so that only the direction and the filters count
Filter: TypeAlias = Callable[[Any, Any], Any]
# what a filter is to it, `build` knows: a pair of them, say
Build: TypeAlias = Callable[[Rate, float, float, Any], optax.GradientTransformation]


def postfiltered(
    rate: Rate, b1: float, b2: float, filter: Filter | None
) -> optax.GradientTransformation:
    """Adam with its moments filtered; without a filter it is Adam."""
    return sd.filtered_adam(rate, b1, b2, eps=EPS, postfilter=filter)


def prefiltered(
    rate: Rate, b1: float, b2: float, filter: Filter | None
) -> optax.GradientTransformation:
    """Adam on filtered gradients."""
    return sd.filtered_adam(rate, b1, b2, eps=EPS, prefilter=filter)


def variants(
    b1s: Sequence[float],
    filters: Mapping[str, Any],
    build: Build = postfiltered,
) -> dict[str, Optimiser]:
    """Each b1 with each filter, by name."""

    def optimiser(b1: float, filter: Any) -> Optimiser:
        return lambda rate: build(rate, b1, 1 - (1 - b1) ** 2, filter)

    return {
        f"b1={b1:g} {name}".strip(): optimiser(b1, filter)
        for b1 in b1s
        for name, filter in filters.items()
    }
