"""Descents: problems that come with gradients, on which optax transformations are compared.

Each configuration is tuned over the same small grid of variants and learning rates, on seeds that
are not scored, and is then run from the scored ones. Every run is kept on disk as soon as it ends.
"""

from benchmarks.descents._denoising import denoising
from benchmarks.descents._descent import Configuration, Descent, Optimiser, Rate, keep_within
from benchmarks.descents._main import run
from benchmarks.descents._variants import EPS, Build, Filter, postfiltered, prefiltered, variants

__all__ = [
    "EPS",
    "Build",
    "Configuration",
    "Descent",
    "Filter",
    "Optimiser",
    "Rate",
    "denoising",
    "keep_within",
    "postfiltered",
    "prefiltered",
    "run",
    "variants",
]
