"""Piecewise smooth signals on a line, of the kind that Fig. 2 and 3 of the paper seek.

Source: Chang et al., "Spatiotemporal Bilateral Gradient Filtering for Inverse Rendering", SIGGRAPH
Asia 2024. The signals are our own: the paper shows its signal and gives no formula.
"""

import numpy as np

PIECES = 8
SHORTEST = 0.05  # of a piece, as a share of the line


def signal(seed: int, size: int) -> np.ndarray:
    """A signal of pieces of random lengths, each a level with a slope and a slow wave."""
    rng = np.random.default_rng(seed)
    lengths = SHORTEST + (1 - PIECES * SHORTEST) * rng.dirichlet(np.ones(PIECES))
    x = (np.arange(size) + 0.5) / size
    piece = np.searchsorted(np.cumsum(lengths)[:-1], x)
    level, slope, phase = rng.uniform((-1, -1, 0), (1, 1, 2 * np.pi), (PIECES, 3)).T
    wave = 0.15 * np.sin(10 * x + phase[piece])
    return (level[piece] + slope[piece] * (x - 0.5) + wave).astype(np.float32)
