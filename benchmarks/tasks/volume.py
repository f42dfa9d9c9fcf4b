"""Density and albedo of a volume from pictures around it, one sample a pixel (Fig. 6 and 7).

Twice: with noisy gradients, whose rays ask one place for its colour, and with cleaner ones, whose
rays ask all that they pass. As in the paper, filters act on density and albedo each by itself. The
paper's 3 passes on 64³ voxels reach a third as far as on 24³.
"""

from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks._descent import Configuration, Descent, adam, filtered, problem
from benchmarks._task import Score, Task, TaskEntry
from benchmarks.scenes import smoke
from benchmarks.scenes._monte_carlo import loss
from benchmarks.scenes.smoke import Camera, Image, Volume
from smoothdiff.filters import bilateral, cross_bilateral, laplacian

TITLE = "Density and albedo of a volume, one sample a pixel"
DENSITY, ALBEDO = 0.02, 0.5  # of the start
REFERENCE, SCORED = 64, 4  # samples of the pictures that are sought and that are scored
MARKS = (25, 50)


def build(full: bool) -> list[Task]:
    size, views = (64, 32) if full else (24, 12)
    scales = {"levels": (1, 2, 3), "sigma_d": (0.03, 0.1, 0.3, 1.0, 3.0)}
    configurations = [
        adam(),
        *(
            Configuration(name, title, partial(filtered, partial(make, ndim=3)), axes)
            for name, title, make, axes in (
                ("laplacian", "Laplacian", laplacian, {"lam": (0.1, 0.3, 1.0, 3.0, 10.0)}),
                ("bilateral", "Bilateral", bilateral, scales),
                ("cross-bilateral", "Cross-bilateral", cross_bilateral, scales),
            )
        ),
    ]

    def gradient(clean: bool, y: Volume, key: jax.Array, scene: dict[str, Any]) -> Volume:
        seen = scene["camera"], scene["reference"]
        return smoke.gradient(y, *seen, key, steps=size, clean=clean)

    return [
        Descent(
            name=name,
            title=f"{TITLE}, {name} gradients",
            problem=problem(
                partial(gradient, clean), partial(scene, size, views), start(size), MARKS[-1], 0, 1
            ),
            score=Score(
                errors=errors,
                levels={
                    "image error": (0.1, 0.03, 0.01),
                    "albedo error where dense": (),
                    "density error": (),
                },
            ),
            start=lambda seed: start(size),
            seeds=5 if full else 3,
            configurations=configurations,
            rate=0.04,
            marks=MARKS,
            tuning_seeds=1,  # of tens of thousands of voxels, each with its own noise
            pictures=pictures,
            target=lambda scene: pictures(scene["volume"], scene),
            notes=f"{size}³ voxels, {views} views of {size} x {size} pixels. The image error is "
            "the squared one, relative to the start.",
        )
        for name, clean in (("noisy", False), ("cleaner", True))
    ]


TASKS = {"volume": TaskEntry(TITLE, "descent", build)}


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
        "loss": loss(_seen(start(size), camera, size, SCORED), scored),
    }


def start(size: int) -> Volume:
    """A thin grey mist."""
    space = (size, size, size)
    return Volume(jnp.full((*space, 1), DENSITY), jnp.full((*space, 3), ALBEDO))


def errors(y: Volume, scene: dict[str, Any]) -> dict[str, jax.Array]:
    size, sought = len(y.density), scene["volume"]
    image = loss(_seen(y, scene["camera"], size, SCORED), scene["scored"]) / scene["loss"]
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


def _seen(volume: Volume, camera: Camera, size: int, samples: int) -> Image:
    """Pictures by the same rays at every call."""
    key = jax.random.key(0)
    return smoke.render(volume, camera, key, pixels=size, steps=size, samples=samples)
