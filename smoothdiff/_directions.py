"""The direction numbers of Sobol's sequence: those of Joe and Kuo, from scipy's own file.

Importing scipy.stats for them takes a second, as long as a short run. It is asked only where that
file is not as expected.
"""

from functools import lru_cache
from pathlib import Path

import numpy as np

# scipy has them for so many dimensions
MAX_DIMENSION = 21_201


@lru_cache(maxsize=32)
def direction_numbers(n: int, bits: int) -> np.ndarray:
    r"""The first `bits` direction numbers of each of n dimensions as 32-bit fractions, (bits, n).

    A dimension has a polynomial over the integers modulo 2, of degree s and with coefficients a,
    and its first s numbers. The others follow, number k as $m_k / 2^k$:

    $$ m_k = m_{k-s} \oplus 2^s m_{k-s} \oplus \bigoplus_{j=1}^{s-1} 2^j a_j m_{k-j} $$

    Source: Joe and Kuo 2008, equation 2.
    """
    try:
        with np.load(_file()) as table:
            polynomials, first = table["poly"][:n], table["vinit"][:n]
    except (OSError, KeyError):
        return _by_scipy(n, bits)
    # the first dimension has no polynomial, and all its numbers are 1
    numbers = np.ones((n, bits), np.int64)
    degrees = np.frexp(polynomials)[1] - 1
    for s in np.unique(degrees[1:]):
        own = degrees == s
        m, polynomial = numbers[own], polynomials[own]
        m[:, :s] = first[own, : min(s, bits)]
        for k in range(s, bits):
            m[:, k] = m[:, k - s] ^ (m[:, k - s] << s)
            for j in range(1, s):
                m[:, k] ^= np.where(polynomial >> (s - j) & 1, m[:, k - j] << j, 0)
        numbers[own] = m
    return (numbers << np.arange(31, 31 - bits, -1)).astype(np.uint32).T


def _file() -> Path:
    """Where scipy has them: for each dimension the polynomial and the first numbers."""
    import scipy  # here, as importing smoothdiff needs none of it

    return Path(scipy.__file__).parent / "stats" / "_sobol_direction_numbers.npz"


def _by_scipy(n: int, bits: int) -> np.ndarray:
    """The same, from points of the sequence."""
    from scipy.stats import qmc

    sequence = qmc.Sobol(n, scramble=False, bits=32)
    rows = []
    for k in range(bits):
        # scipy orders the points by Gray code: point 2^(k+1) - 1 is direction number k
        sequence.reset().fast_forward(2 ** (k + 1) - 1)
        rows.append(np.round(sequence.random(1)[0] * 2.0**32).astype(np.uint32))
    return np.stack(rows)
