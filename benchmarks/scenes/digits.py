"""Handwritten digits: scikit-learn's of 8 x 8 pixels, as they are or enlarged to 28 x 28."""

import numpy as np
from scipy import ndimage

from benchmarks._task import NotAble

PIXELS = 28


def load() -> tuple[np.ndarray, np.ndarray]:
    """All digits as they were written, (1797, 8, 8) from 0 to 1, and which digit each is."""
    try:
        from sklearn import datasets
    except ImportError as error:
        raise NotAble("needs a package: pip install scikit-learn") from error
    values, which = datasets.load_digits(return_X_y=True)
    return np.asarray(values).reshape(-1, 8, 8) / 16, np.asarray(which)


def enlarged(digit: np.ndarray) -> np.ndarray:
    """One digit in 28 x 28 pixels, by linear interpolation."""
    size = digit.shape[0]
    at = (np.arange(PIXELS) + 0.5) * size / PIXELS - 0.5
    points = np.meshgrid(at, at, indexing="ij")
    return ndimage.map_coordinates(digit, points, order=1, mode="nearest")
