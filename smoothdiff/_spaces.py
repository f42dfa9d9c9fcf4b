"""What a space is: the values that a parameter may have, and its unit coordinate."""

import abc
import dataclasses
import math
from collections.abc import Sequence
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from smoothdiff._numbers import floating
from smoothdiff._params import is_concrete

# a number, or one for each number of the parameter; kept as Python numbers in tuples, so that
# spaces are equal, hash and print by value
Numbers = ArrayLike | Sequence

# the smoothing width in unit coordinates, unless there is a reason for another; of a range the
# share that it is
SIGMA = 0.2


@dataclasses.dataclass(frozen=True, kw_only=True)
class AbstractSpace(abc.ABC):
    r"""What a parameter may be, and its unit coordinate, in which a solver searches.

    $$ y = t(u), \qquad u = t^{-1}(y) $$

    The function sees natural values, a solver sees unit ones; both have the shape of the parameter,
    whose last axes are also those of the numbers that a space is made of. Spaces are equal if
    their values are.

    Args:
        sigma: the smoothing width in unit coordinates, a number or one for each number of the
            parameter; by default what the subclass says, see `width`.
        label: a name for plots, with the unit; or one for each number of the parameter.

    Raises:
        ValueError: a sigma that is not a positive number.

    Example:
        An area, which is searched by its side:

        >>> import dataclasses
        >>> import jax.numpy as jnp, smoothdiff as sd
        >>> @dataclasses.dataclass(frozen=True)
        ... class Root(sd.AbstractSpace):
        ...     def to_unit(self, y):
        ...         return jnp.sqrt(y)
        ...     def to_natural(self, u):
        ...         return jnp.square(u)
        >>> area = Root(sigma=0.5, label="area (m²)")
        >>> float(area.to_unit(9.0)), float(area.to_natural(2.0))
        (3.0, 4.0)

    Source: own.
    """

    sigma: Any = None
    label: Any = None

    def __post_init__(self):
        if self.sigma is not None:
            self._number("sigma", positive=True)
        if self.label is not None and not isinstance(self.label, str):
            object.__setattr__(self, "label", _tuples(np.asarray(self.label, str).tolist()))

    def width(self, share: Any = SIGMA) -> Any:
        """The smoothing width in unit coordinates.

        Args:
            share: of a range, where sigma was left out; a number, or one for each number of the
                parameter.

        Returns:
            Sigma, or the default: a number, or one for each number of the parameter.
        """
        return self._default_width(share) if self.sigma is None else self.sigma

    @abc.abstractmethod
    def to_unit(self, y: ArrayLike) -> Array:
        """The unit coordinate of a natural value."""

    @abc.abstractmethod
    def to_natural(self, u: ArrayLike) -> Array:
        """The natural value at a unit coordinate; never out of the range, not even by rounding."""

    def to_axis(self, u: ArrayLike) -> Array:
        """Where plots show a unit coordinate: the natural value."""
        return self.to_natural(u)

    @property
    def unit_bounds(self) -> tuple[float, float]:
        """The least and the largest unit coordinate; infinite where there is no end."""
        return -math.inf, math.inf

    @property
    def axis_scale(self) -> Literal["linear", "log"]:
        """The scale on which plots show natural values."""
        return "linear"

    def starting_at(self, y0: Array, name: str) -> "AbstractSpace":
        """This space for a parameter that starts at `y0`, which errors call by its name.

        Raises:
            ValueError: the parameter cannot start there, or has another shape.
        """
        for field in dataclasses.fields(self):
            shape = np.shape(getattr(self, field.name) or 0)
            if not _broadcasts(shape, y0.shape):
                raise ValueError(
                    f"{field.name} of {type(self).__name__} has shape {shape}, which does not "
                    f"broadcast to the shape {y0.shape} of the parameter{name}"
                )
        self._check_dtype(y0.dtype, name)
        if is_concrete(y0):
            self._check_start(np.asarray(y0), name)
        return self

    def _check_dtype(self, dtype: np.dtype, name: str) -> None:
        """Raises ValueError if the dtype of the parameter cannot hold the space."""
        if self.sigma is not None:
            self._check_held("sigma", dtype, name)

    def _check_start(self, y0: np.ndarray, name: str) -> None:
        """Raises ValueError if the space does not hold the start."""
        refuse(~np.isfinite(y0), y0, name, "is not finite: start at a number")

    def _check_held(self, field: str, dtype: np.dtype, name: str) -> None:
        value, dtype = getattr(self, field), floating(np.zeros(0, dtype)).dtype
        with np.errstate(over="ignore", under="ignore"):
            stored = np.asarray(value).astype(dtype)
        if not np.all(np.isfinite(stored) & (stored >= jnp.finfo(dtype).tiny)):
            raise ValueError(
                f"{field} = {value} of the parameter{name} is beyond {dtype}: pass the parameter "
                "in float64, or in other units"
            )

    def _default_width(self, share: Any) -> Any:
        del share  # of a range, which this is not
        return SIGMA

    def _number(
        self, name: str, *, positive: bool = False, whole: bool = False, advice: str = ""
    ) -> np.ndarray:
        """Makes Python numbers of a field, and returns them as an array.

        Raises:
            ValueError: the field has other than finite numbers, positive or whole if they must be.
        """
        value = getattr(self, name)
        given = f"{name} = {value} of {type(self).__name__}"
        try:
            numbers = np.asarray(value).astype(float, casting="same_kind")
        except (TypeError, ValueError) as error:
            raise ValueError(f"{given} must be a real number or an array of them") from error
        if not np.all(np.isfinite(numbers)):
            raise ValueError(f"{given} must be finite{advice}")
        if positive and not np.all(numbers > 0):
            raise ValueError(f"{given} must be positive")
        if whole:
            # beyond, some whole numbers are no floats
            if not np.all((numbers == np.round(numbers)) & (np.abs(numbers) < 2**53)):
                raise ValueError(
                    f"{given} must be a whole number below 2**53: round it, or use Range for a "
                    "parameter that may lie in between"
                )
            numbers = numbers.astype(int)
        object.__setattr__(self, name, _tuples(numbers.tolist()))
        return numbers


def fit(value: Any, like: Array) -> Array:
    """Numbers in the dtype of an array, in a shape that goes with its own."""
    value = jnp.asarray(np.asarray(value), like.dtype)
    return jnp.broadcast_to(value, np.broadcast_shapes(value.shape, like.shape))


def refuse(bad: Any, y0: np.ndarray, name: str, why: str) -> None:
    """Raises ValueError about the first number that is bad, if there is one."""
    bad = np.broadcast_to(bad, y0.shape)
    if np.any(bad):
        raise ValueError(f"the parameter{name} = {y0[bad][0]} {why}")


def _broadcasts(shape: tuple[int, ...], to: tuple[int, ...]) -> bool:
    try:
        return np.broadcast_shapes(shape, to) == to
    except ValueError:
        return False


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value
