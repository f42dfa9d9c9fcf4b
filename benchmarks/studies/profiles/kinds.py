"""What methods see in place of the exact values: with noise, rounded, or as stairs."""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np

# (exact values, the scale of those at the start, random numbers) -> the values that are seen
Disturb: TypeAlias = Callable[[np.ndarray, float, np.random.Generator], np.ndarray]


class Kind(NamedTuple):
    """A kind of function; noisy are those that say something else each time."""

    title: str
    disturb: Disturb
    noisy: bool = False


def scale(values: np.ndarray) -> float:
    """The root of their mean square, or 1 where they are all zero."""
    return float(np.sqrt(np.mean(values**2))) or 1.0


def exact(values: np.ndarray, at_start: float, rng: np.random.Generator) -> np.ndarray:
    return values


def noise(share: float) -> Disturb:
    """Each value is off by a normal number times this share of itself."""
    return lambda values, at_start, rng: values * (1 + share * rng.normal(size=values.shape))


def rounded(share: float) -> Disturb:
    """To a grid of this share of the scale at the start."""

    def disturb(values: np.ndarray, at_start: float, rng: np.random.Generator) -> np.ndarray:
        return np.round(values / (share * at_start)) * (share * at_start)

    return disturb


def floored(share: float) -> Disturb:
    """Likewise, down to the next step of the stairs."""

    def disturb(values: np.ndarray, at_start: float, rng: np.random.Generator) -> np.ndarray:
        return np.floor(values / (share * at_start)) * (share * at_start)

    return disturb


CLEAN = Kind("clean", exact)
RESIDUALS = (
    CLEAN,
    Kind("noise of 1 %", noise(1e-2), noisy=True),
    Kind("noise of 0.1 %", noise(1e-3), noisy=True),
    Kind("quantised", rounded(1e-2)),
)
SCALARS = (*RESIDUALS, Kind("stairs", floored(1e-1)))
