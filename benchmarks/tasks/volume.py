"""Density and albedo of a volume from pictures around it, one sample a pixel (Fig. 6 and 7).

Twice: with noisy gradients, whose rays ask one place for its colour, and with cleaner ones, whose
rays ask all that they pass. As in the paper, filters act on density and albedo each by itself, and
b1 is 0.2. Passes are tuned: the paper's 3 on 64³ voxels reach a quarter of 32³. The data scale is
our own, since the paper's belong to its units.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import optax

import smoothdiff as sd
from benchmarks.descents import (
    Configuration,
    Descent,
    Optimiser,
    Rate,
    keep_within,
    postfiltered,
    variants,
)
from benchmarks.scenes import smoke
from benchmarks.scenes.smoke import Camera, Image, Volume

TITLE = "Density and albedo of a volume, one sample a pixel"
DENSITY, ALBEDO = 0.02, 0.5  # of the start
REFERENCE, SCORED = 64, 4  # samples of the pictures that are sought and that are scored
RATES = (0.01, 0.02, 0.04, 0.08)
SIGMA_D = 0.1  # of density and of albedo, which are in [0, 1]
DECAY = (0.2,)  # b1, the paper's best
MARKS = (10, 25, 50)


def build(full: bool) -> list[Descent]:
    size, views = (64, 32) if full else (32, 16)
    smooth = {f"lam={lam}": _both(sd.filters.laplacian(lam, ndim=3)) for lam in (0.3, 1)}
    by_itself = {f"levels={n}": _both(sd.filters.bilateral(1.0, n, ndim=3)) for n in (1, 2)}
    guided = {f"levels={n}": _both(sd.filters.cross_bilateral(SIGMA_D, n, ndim=3)) for n in (1, 2)}
    configurations = (
        Configuration("adam", "Adam", tried({"": _both(None)}, (0.2, 0.5, 0.9))),
        Configuration("laplacian", "Laplacian", tried(smooth)),
        Configuration("bilateral", "Bilateral", tried(by_itself)),
        Configuration("cross-bilateral", "Cross-bilateral", tried(guided)),
    )
    return [
        Descent(
            name=name,
            title=f"{TITLE}, {name} gradients",
            scene=lambda seed: scene(size, views),
            start=lambda seed, scene: start(size),
            gradient=lambda y, key, scene, clean=clean: smoke.gradient(
                y, scene["camera"], scene["reference"], key, steps=size, clean=clean
            ),
            errors=errors,
            score="image error",
            configurations=configurations,
            rates=RATES,
            marks=MARKS,
            levels=(0.1, 0.03, 0.01),
            seeds=3,
            tuning_seeds=1,  # of tens of thousands of voxels, each with its own noise
            pictures=pictures,
            target=lambda scene: pictures(scene["volume"], scene),
            notes=f"{size}³ voxels, {views} views of {size} x {size} pixels. The image error is "
            "the squared one, relative to the start.",
        )
        for name, clean in (("noisy", False), ("cleaner", True))
    ]


@cache
def scene(size: int, views: int) -> dict[str, Any]:
    """What is sought, its pictures, and what scores need."""
    volume, camera = smoke.target(size), smoke.cameras(views)
    scored = _seen(volume, camera, size, SCORED)
    return {
        "volume": volume,
        "camera": camera,
        "reference": _seen(volume, camera, size, REFERENCE),
        "scored": scored,
        "loss": smoke.loss(_seen(start(size), camera, size, SCORED), scored),
    }


def start(size: int) -> Volume:
    """A thin grey mist."""
    space = (size, size, size)
    return Volume(jnp.full((*space, 1), DENSITY), jnp.full((*space, 3), ALBEDO))


def errors(y: Volume, scene: dict[str, Any]) -> dict[str, jax.Array]:
    size, sought = len(y.density), scene["volume"]
    image = smoke.loss(_seen(y, scene["camera"], size, SCORED), scene["scored"]) / scene["loss"]
    square = jnp.mean((y.albedo - sought.albedo) ** 2, -1, keepdims=True)
    return {
        "image error": image,
        "density error": jnp.sqrt(jnp.mean((y.density - sought.density) ** 2)),
        "albedo error where dense": jnp.sqrt(jnp.average(square, weights=sought.density)),
    }


def pictures(y: Volume, scene: dict[str, Any]) -> dict[str, Any]:
    """Two views, and a cut through the middle."""
    size = len(y.density)
    first, second, *_ = _seen(y, scene["camera"], size, REFERENCE)
    return {
        "a view": second,
        "another view": first,
        "density, cut": y.density[size // 2, :, :, 0].T,
        "density x albedo, cut": (y.density * y.albedo)[size // 2].transpose(1, 0, 2),
    }


def tried(filters: Mapping[str, Any], b1s: Sequence[float] = DECAY) -> dict[str, Optimiser]:
    """The variants of a pair of filters; density and albedo stay in [0, 1]."""

    def each(rate: Rate, b1: float, b2: float, filters: Any) -> optax.GradientTransformation:
        leaves = {
            name: postfiltered(rate, b1, b2, filter) for name, filter in filters._asdict().items()
        }
        names = _pair(*Volume._fields)
        return optax.chain(optax.multi_transform(leaves, names), keep_within(0.0, 1.0))

    return variants(b1s, filters, each)


def _pair(density: Any, albedo: Any) -> Any:
    """What belongs to density and to albedo, if it is no array."""
    return Volume(density, albedo)


def _both(filter: Any) -> Any:
    return _pair(filter, filter)


def _seen(volume: Volume, camera: Camera, size: int, samples: int) -> Image:
    """Pictures by the same rays at every call."""
    key = jax.random.key(0)
    return smoke.render(volume, camera, key, pixels=size, steps=size, samples=samples)
