"""Spaces without ends: real, positive and periodic parameters."""

import dataclasses
import math
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from smoothdiff._numbers import floating
from smoothdiff._params import is_concrete
from smoothdiff._spaces import SIGMA, AbstractSpace, Numbers, fit, refuse


@dataclasses.dataclass(frozen=True)
class Real(AbstractSpace):
    r"""A parameter without bounds, in units of a typical size.

    $$ y = s u $$

    Args:
        scale: how large the parameter typically is, or how far it may have to go, in its units: a
            number or one for each number of the parameter.
        sigma: the smoothing width in units of `scale`, by default a fifth.
        label: a name for plots, such as "offset (mm)"; or one for each number of the parameter.

    Raises:
        ValueError: a scale that is not positive.

    Example:
        >>> import smoothdiff as sd
        >>> offset = sd.Real(50.0, label="offset (mm)")
        >>> float(offset.to_unit(100.0)), float(offset.to_natural(0.5))
        (2.0, 25.0)

    Source: own.
    """

    scale: Numbers

    def __post_init__(self):
        super().__post_init__()
        self._number("scale", positive=True)

    def to_unit(self, y: ArrayLike) -> Array:
        """The natural value in units of the scale."""
        y = floating(y)
        return y / fit(self.scale, y)

    def to_natural(self, u: ArrayLike) -> Array:
        """The scale times the unit coordinate."""
        u = floating(u)
        return u * fit(self.scale, u)

    def _check_dtype(self, dtype: np.dtype, name: str) -> None:
        super()._check_dtype(dtype, name)
        self._check_held("scale", dtype, name)


@dataclasses.dataclass(frozen=True)
class Positive(AbstractSpace):
    r"""A positive parameter of which not even the magnitude may be known, on a logarithmic scale.

    $$ y = s e^u $$

    Args:
        scale: the value at which the unit coordinate is zero, a number or one for each number of
            the parameter. None: the starting value; 1 where there is none.
        sigma: the smoothing width in natural logarithms, by default log 2, a factor of two.
        label: a name for plots, such as "density (kg/m³)"; or one for each number of the parameter.

    Raises:
        ValueError: a scale that is not positive.

    Example:
        >>> import math, smoothdiff as sd
        >>> density = sd.Positive(1000.0)
        >>> [round(float(density.to_natural(u))) for u in (-math.log(2), 0.0, math.log(2))]
        [500, 1000, 2000]

    Source: own.
    """

    scale: Numbers | None = None

    def __post_init__(self):
        super().__post_init__()
        if self.scale is not None:
            self._number("scale", positive=True)

    def to_unit(self, y: ArrayLike) -> Array:
        """The logarithm of the natural value in units of the scale."""
        # a quotient of roots cannot overflow
        y = floating(y)
        return 2 * jnp.log(jnp.sqrt(y) / jnp.sqrt(self._scale(y)))

    def to_natural(self, u: ArrayLike) -> Array:
        """The scale times the exponential; at least and at most what the dtype can hold."""
        # in two halves, so that one overflows only if the value does
        u = floating(u)
        half, info = jnp.exp(u / 2), jnp.finfo(u.dtype)
        return jnp.clip(self._scale(u) * half * half, info.tiny, info.max)

    @property
    def axis_scale(self) -> Literal["linear", "log"]:
        """Logarithmic."""
        return "log"

    def starting_at(self, y0: Array, name: str) -> "AbstractSpace":
        """This space with the start for a scale, if it has none.

        Raises:
            ValueError: as for other spaces, or without a scale while JAX traces the start.
        """
        space = super().starting_at(y0, name)
        if self.scale is not None:
            return space
        if not is_concrete(y0):
            raise ValueError(
                f"the parameter{name} is traced, so that its value is no scale: Positive(scale)"
            )
        return dataclasses.replace(space, scale=np.asarray(y0))

    def _scale(self, like: Array) -> Array:
        return fit(1.0 if self.scale is None else self.scale, like)

    def _default_width(self, share: Any) -> float:
        del share
        return math.log(2)

    def _check_dtype(self, dtype: np.dtype, name: str) -> None:
        super()._check_dtype(dtype, name)
        if self.scale is not None:
            self._check_held("scale", dtype, name)

    def _check_start(self, y0: np.ndarray, name: str) -> None:
        super()._check_start(y0, name)
        least = jnp.finfo(floating(y0).dtype).tiny
        refuse(y0 < least, y0, name, "is not positive: start above zero, or use Real or Range")


@dataclasses.dataclass(frozen=True)
class Periodic(AbstractSpace):
    r"""A parameter that comes back to where it was, such as an angle.

    $$ y = l + p \, (u - \lfloor u \rfloor) $$

    A search goes round as often as it likes; the function sees values from l up to, but not
    including, l + p.

    Args:
        period: after which all is the same, in the units of the parameter: a number or one for each
            number of the parameter.
        low: the least value that the function sees, likewise.
        sigma: the smoothing width in periods, by default a tenth: two values are at most half a
            period apart, and this is a fifth of that.
        label: a name for plots, such as "angle (rad)"; or one for each number of the parameter.

    Raises:
        ValueError: a period that is not positive.

    Example:
        >>> import smoothdiff as sd
        >>> heading = sd.Periodic(360.0, low=-180.0, label="heading (deg)")
        >>> [float(heading.to_natural(u)) for u in (0.0, 0.75, 1.0, 1.75)]
        [-180.0, 90.0, -180.0, 90.0]

    Source: own.
    """

    period: Numbers = 2 * math.pi
    low: Numbers = 0.0

    def __post_init__(self):
        super().__post_init__()
        self._number("period", positive=True)
        self._number("low")

    def to_unit(self, y: ArrayLike) -> Array:
        """The natural value in periods from `low`, which need not be the first one."""
        y = floating(y)
        return (y - fit(self.low, y)) / fit(self.period, y)

    def to_natural(self, u: ArrayLike) -> Array:
        """The natural value within the first period."""
        u = floating(u)
        low, period = fit(self.low, u), fit(self.period, u)
        y = low + period * (u - jnp.floor(u))
        # rounded up, the last value before the end is the first one again
        return jnp.where(y >= low + period, low, y)

    def to_axis(self, u: ArrayLike) -> Array:
        """Where plots show a unit coordinate: in the period that it is in, not the first one."""
        u = floating(u)
        return fit(self.low, u) + fit(self.period, u) * u

    def _default_width(self, share: Any) -> float:
        del share
        return SIGMA / 2

    def _check_dtype(self, dtype: np.dtype, name: str) -> None:
        super()._check_dtype(dtype, name)
        self._check_held("period", dtype, name)
