"""What a host function returned in the dtype that was promised, without silent losses.

Runs inside JAX's callbacks: NumPy only.
"""

from typing import Any

import numpy as np

_BOOL, _INTEGER, _FLOAT, _COMPLEX, _OTHER = range(5)
_WIDEST = np.bool_, np.int64, np.float64, np.complex128
# besides what keeps its kind
_HARMLESS = (_BOOL, _INTEGER), (_FLOAT, _COMPLEX)


def as_promised(value: Any, dtype: np.dtype, shape: tuple[int, ...]) -> np.ndarray:
    """The value as an array of this dtype and shape; only a float may be rounded.

    As in JAX, a plain Python number takes the type that is asked for; an array must have its kind.

    Raises:
        TypeError, ValueError: the value has another shape or kind, does not fit, or is masked.
    """
    array = np.asarray(value)
    if array.shape != shape:
        raise ValueError(f"shape {array.shape} instead of {shape}")
    if np.ma.is_masked(value):
        raise TypeError(
            f"the masked array {_short(value)}, whose mask would be lost in {dtype}: return "
            "numbers, for example value.filled(0)"
        )
    given, wanted = _kind(array.dtype), _kind(dtype)
    weak = isinstance(value, bool | int | float) and given <= wanted
    if given != wanted and not weak and (given, wanted) not in _HARMLESS:
        raise TypeError(f"dtype {array.dtype} instead of {dtype}: {_short(array)}")
    with np.errstate(all="ignore"):  # an overflow to inf is caught as not finite
        cast = array.astype(dtype)
    if wanted == _INTEGER and np.any(lost := cast != array):
        raise ValueError(
            f"{array[lost][0]} does not fit into {dtype}: return floats, or promise a wider type "
            "in `out` (one of 64 bits needs jax_enable_x64)"
        )
    return cast


def _kind(dtype: np.dtype) -> int:
    # by what it can be cast to, as NumPy has no kind for bfloat16, int4 and so on
    casts = (kind for kind, to in enumerate(_WIDEST) if np.can_cast(dtype, to, "same_kind"))
    return next(casts, _OTHER)


def _short(array: np.ndarray) -> str:
    with np.printoptions(threshold=6, edgeitems=2, precision=8):
        return str(array)[:100]
