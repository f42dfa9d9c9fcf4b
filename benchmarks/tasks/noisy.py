"""A line of 1,000 parameters under an isotropic quadratic, with noisy gradients (Fig. 3).

f(y) = |y - y*|² with y* piecewise smooth; normal noise is added to each gradient. What a filter
gains here it gains by taking noise away. Fig. 4 is drawn too: a gradient before and after filters.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import optax

import smoothdiff as sd
from benchmarks.descents import Configuration, Descent, denoising, variants
from benchmarks.scenes import piecewise

TITLE = "Isotropic quadratic on a line, noisy gradients"
SIZE = 1000
NOISE = 2.0  # of a gradient; without noise it starts at about 1
STEPS = 250
RATES = (0.003, 0.01, 0.03, 0.1, 0.3)
DECAYS = (0.2, 0.5, 0.9)


def build(full: bool) -> Descent:
    smooth = {f"lam={lam}": sd.filters.laplacian(lam, ndim=1) for lam in (10, 100)}
    by_itself = {f"sigma_d={s}": sd.filters.bilateral(s, 5, ndim=1, log=False) for s in (1.0, 3.0)}
    guided = {f"sigma_d={s}": sd.filters.cross_bilateral(s, 5, ndim=1) for s in (0.1, 0.3)}
    return Descent(
        name="noisy",
        title=TITLE,
        scene=lambda seed: jnp.asarray(piecewise.signal(seed, SIZE)),
        start=lambda seed, sought: jnp.zeros(SIZE),
        gradient=lambda y, key, sought: exact(y, sought) + NOISE * jax.random.normal(key, (SIZE,)),
        errors=errors,
        score="parameter error",
        configurations=(
            Configuration("adam", "Adam", variants(DECAYS, {"": None})),
            Configuration(
                "gradient-descent", "Gradient descent", {"": lambda rate: optax.sgd(rate)}
            ),
            Configuration("laplacian", "Laplacian", variants(DECAYS, smooth)),
            Configuration("bilateral", "Bilateral", variants(DECAYS, by_itself)),
            Configuration("cross-bilateral", "Cross-bilateral", variants(DECAYS, guided)),
            Configuration("memoryless", "Cross-bilateral, memoryless", variants((0.0,), guided)),
        ),
        rates=RATES,
        marks=(10, 25, 50, 100, STEPS),
        levels=(0.3, 0.1, 0.05),
        seeds=10,
        pictures=lambda y, sought: {"y": y},
        target=lambda sought: {"y": sought},
        pictured=(25, STEPS),
        also=lambda folder: half_way(folder, smooth, by_itself, guided),
        notes=f"The error is relative to the start; normal noise of {NOISE} on each gradient.",
    )


def exact(y: jax.Array, sought: jax.Array) -> jax.Array:
    """The gradient without noise."""
    return 2 * (y - sought)


def errors(y: jax.Array, sought: jax.Array) -> dict[str, jax.Array]:
    return {"parameter error": jnp.linalg.norm(y - sought) / jnp.linalg.norm(sought)}


def half_way(folder: Path, smooth: dict, by_itself: dict, guided: dict) -> dict[str, Any]:
    """Draws a gradient half way from the start to what is sought, before and after filters."""
    sought = jnp.asarray(piecewise.signal(0, SIZE))
    gradient = exact(sought / 2, sought)
    return denoising(
        lambda key: gradient + NOISE * jax.random.normal(key, (SIZE,)),
        gradient,
        sought / 2,
        {"Laplacian": smooth, "Bilateral": by_itself, "Cross-bilateral": guided},
        folder / "denoising.png",
    )
