"""Spaces with ends: a range, linear or logarithmic, and the whole numbers of one."""

import dataclasses
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from smoothdiff._numbers import floating
from smoothdiff._spaces import AbstractSpace, Numbers, fit, refuse


@dataclasses.dataclass(frozen=True)
class Range(AbstractSpace):
    r"""A parameter within a range, on a linear or a logarithmic scale.

    $$ y = (1 - u) l + u h, \quad\text{with log}\quad y = l^{1 - u} h^u, \qquad u \in [0, 1] $$

    Args:
        low: the least value, in the units of the parameter: a number or one for each number of the
            parameter.
        high: the largest value, itself included, likewise.
        log: on a logarithmic scale, for a parameter that may be small by any factor.
        sigma: the smoothing width as a share of the range. By default what the call takes of any
            range: a fifth, `least_squares` often two fifths, and less from a start near an end.
        label: a name for plots, such as "width (mm)"; or one for each number of the parameter.

    Raises:
        ValueError: no range, or a logarithmic one that reaches zero.

    Example:
        >>> import smoothdiff as sd
        >>> roughness = sd.Range(0.01, 1.0, log=True)
        >>> [round(float(roughness.to_natural(u)), 3) for u in (0.0, 0.5, 1.0)]
        [0.01, 0.1, 1.0]

    Source: own.
    """

    low: Numbers
    high: Numbers
    log: bool = dataclasses.field(default=False, kw_only=True)

    def __post_init__(self):
        super().__post_init__()
        advice = ": for a parameter without ends there are Real and Positive"
        low, high = (self._number(name, advice=advice) for name in ("low", "high"))
        _check_order(self, low, high)
        if self.log and not np.all(low > 0):
            raise ValueError(
                f"low = {self.low} of a Range with log=True must be positive, since a logarithmic "
                "scale never reaches zero: give the least value that matters, such as 1e-3"
            )

    def to_unit(self, y: ArrayLike) -> Array:
        """The unit coordinate of a natural value; beyond an end that of the end."""
        y = floating(y)
        low, high = fit(self.low, y), fit(self.high, y)
        inside = jnp.clip(y, low, high)
        if self.log:
            middle, length = self._logs(y)
            # roots, and below half the exponent: neither overflows or vanishes on the way
            half = jnp.log(jnp.sqrt(inside) / jnp.sqrt(middle))
            u = jnp.clip(0.5 + 2 * half / length, 0, 1)
        else:
            u = (inside - low) / (high - low)
        return jnp.where(y <= low, 0, jnp.where(y >= high, 1, u))

    def to_natural(self, u: ArrayLike) -> Array:
        """The natural value at a unit coordinate; beyond [0, 1] that of the nearest end."""
        u = jnp.clip(floating(u), 0, 1)
        low, high = fit(self.low, u), fit(self.high, u)
        if self.log:
            middle, length = self._logs(u)
            half = jnp.exp(length * (u - 0.5) / 2)
            y = middle * half * half
        else:
            y = (1 - u) * low + u * high
        # at the ends, and between them, whatever rounding does
        return jnp.where(u <= 0, low, jnp.where(u >= 1, high, jnp.clip(y, low, high)))

    @property
    def unit_bounds(self) -> tuple[float, float]:
        """Zero and one."""
        return 0.0, 1.0

    def _default_width(self, share: Any) -> Any:
        return share

    @property
    def axis_scale(self) -> Literal["linear", "log"]:
        """The scale of the range."""
        return "log" if self.log else "linear"

    def _logs(self, like: Array) -> tuple[Array, Array]:
        """The middle of a logarithmic range, from where exponents are smallest, and its length."""
        low, high = np.asarray(self.low), np.asarray(self.high)
        return fit(np.sqrt(low) * np.sqrt(high), like), fit(np.log(high) - np.log(low), like)

    def _held(self, dtype: np.dtype) -> tuple[np.ndarray, np.ndarray]:
        with np.errstate(over="ignore", under="ignore"):
            return np.asarray(self.low).astype(dtype), np.asarray(self.high).astype(dtype)

    def _check_dtype(self, dtype: np.dtype, name: str) -> None:
        super()._check_dtype(dtype, name)
        dtype = floating(np.zeros(0, dtype)).dtype
        low, high = self._held(dtype)
        with np.errstate(over="ignore"):
            usable = (low < high) & np.isfinite(high - low)
        if self.log:
            usable &= low >= jnp.finfo(dtype).tiny
        if not np.all(usable):
            raise ValueError(
                f"the range [{self.low}, {self.high}] of the parameter{name} is too narrow or too "
                f"wide for {dtype}: pass the parameter in float64, or in other units"
            )

    def _check_start(self, y0: np.ndarray, name: str) -> None:
        super()._check_start(y0, name)
        _refuse_outside(self, y0, *self._held(floating(y0).dtype), name)


@dataclasses.dataclass(frozen=True)
class Integer(AbstractSpace):
    r"""A whole number of a range. The function sees integers, so that it can index with them.

    $$ y = l + \lfloor n u \rfloor, \qquad n = h - l + 1, \quad u \in [0, 1] $$

    Each of the n numbers has an interval of the same width 1 / n, the ends too, and the unit
    coordinate of a number is the middle of its interval.

    If all parameters are whole numbers, with fewer than 100 of them, `minimise` and `least_squares`
    evaluate a function without noise once at each point, and end where it is known at all. Two
    points, and what is returned, are evaluated twice, to see that there is no noise.

    Args:
        low: the least number, or one for each number of the parameter.
        high: the largest number, itself included, likewise.
        sigma: the smoothing width as a share of the n intervals. By default as for `Range`, and at
            least an interval, so that its neighbours are seen.
        label: a name for plots, such as "layers"; or one for each number of the parameter.

    Raises:
        ValueError: no range, or ends that are not whole.

    Example:
        >>> import smoothdiff as sd
        >>> die = sd.Integer(1, 6)
        >>> [int(die.to_natural(u)) for u in (0.0, 0.16, 0.17, 0.5, 1.0)]
        [1, 1, 2, 4, 6]

    Source: own.
    """

    low: Numbers
    high: Numbers

    def __post_init__(self):
        advice = ": any number that is large enough will do"
        low, high = (self._number(name, whole=True, advice=advice) for name in ("low", "high"))
        _check_order(self, low, high)
        super().__post_init__()

    def to_unit(self, y: ArrayLike) -> Array:
        """The middle of the interval of a whole number; beyond an end that of the end."""
        y = jnp.asarray(y)
        # differences of integers are exact, whatever the size of the numbers
        y = y if jnp.issubdtype(y.dtype, jnp.floating) else y.astype(int)
        last = fit(self.count() - 1, y)
        index = floating(jnp.clip(y - fit(self.low, y), 0, last))
        return (index + 0.5) / fit(self.count(), index)

    def to_natural(self, u: ArrayLike) -> Array:
        """The number in whose interval a unit coordinate lies, in JAX's default integer dtype."""
        u = floating(u)
        count = fit(self.count(), u)
        index = jnp.clip(jnp.floor(u * count), 0, count - 1).astype(int)
        return fit(self.low, index) + index

    def to_axis(self, u: ArrayLike) -> Array:
        """Where plots show a unit coordinate: the intervals of the numbers around them."""
        u = floating(u)
        return fit(self.low, u) - 0.5 + u * fit(self.count(), u)

    @property
    def unit_bounds(self) -> tuple[float, float]:
        """Zero and one."""
        return 0.0, 1.0

    def count(self) -> np.ndarray:
        """How many numbers there are."""
        return np.asarray(np.subtract(self.high, self.low) + 1)

    def _default_width(self, share: Any) -> Any:
        return np.maximum(share, 1 / self.count())

    def _check_dtype(self, dtype: np.dtype, name: str) -> None:
        super()._check_dtype(dtype, name)
        default = jnp.asarray(0).dtype
        seen = dtype if jnp.issubdtype(dtype, jnp.integer) else default
        least = max(np.iinfo(seen).min, np.iinfo(default).min)
        most = min(np.iinfo(seen).max, np.iinfo(default).max)
        unit = floating(np.zeros(0, dtype)).dtype
        # with more, the middles of intervals round to their edges
        distinct = np.all(self.count() <= 2 ** (jnp.finfo(unit).nmant - 1))
        if np.any(np.less(self.low, least)) or np.any(np.greater(self.high, most)) or not distinct:
            raise ValueError(
                f"the whole numbers [{self.low}, {self.high}] of the parameter{name} are too many "
                f"for {unit} or too large for {seen}: take fewer, or switch on jax_enable_x64"
            )

    def _check_start(self, y0: np.ndarray, name: str) -> None:
        super()._check_start(y0, name)
        refuse(y0 != np.round(y0), y0, name, "is not a whole number: round it, or use Range")
        _refuse_outside(self, y0, np.asarray(self.low), np.asarray(self.high), name)


def _check_order(space: Range | Integer, low: np.ndarray, high: np.ndarray) -> None:
    try:
        rises = bool(np.all(low < high))
    except ValueError as error:
        raise ValueError(
            f"low and high of {type(space).__name__} have shapes {low.shape} and {high.shape}, "
            "which do not broadcast: give one number of each for each number of the parameter"
        ) from error
    if not rises:
        raise ValueError(
            f"low = {space.low} of {type(space).__name__} must be below high = {space.high}: give "
            "(low, high); a parameter that never changes belongs in args"
        )


def _refuse_outside(
    space: Range | Integer, y0: np.ndarray, low: np.ndarray, high: np.ndarray, name: str
) -> None:
    why = (
        f"lies outside its range [{space.low}, {space.high}]: choose it within, or widen the range"
    )
    refuse((y0 < low) | (y0 > high), y0, name, why)
