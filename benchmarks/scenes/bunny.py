"""Bunny: where is a body with two ears, and how far is it turned?

After the Bunny task of higher-order differentiable rendering (section 4.1). As there, it is set up
for the renderer's own AD: the body always overlaps the one in the photograph, and no start is on a
plateau.

Left out: all light but that of one point at the camera: no noise and no shadows. The mesh has 162
vertices, as normals that are interpolated make it smooth.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from benchmarks._task import Budget, Task
from benchmarks.scenes._mitsuba_task import (
    DIRECT,
    DIRECT_AD,
    camera,
    flash,
    mesh,
    paint,
    scene_task,
)
from benchmarks.scenes.meshes import icosphere

TITLE = "Bunny: position and rotation"

CAMERA = (0, -8, 0.8)
# where the body bulges: direction, how far, and how narrow
BULGES = (
    ((0.55, 0.0, 1.0), 1.0, 14.0),  # ears
    ((-0.55, 0.0, 1.0), 1.0, 14.0),
    ((0.0, -1.0, 0.2), 0.5, 6.0),  # nose
    ((0.0, 1.0, -0.6), 0.25, 8.0),  # tail
)


def build(full: bool) -> Task:
    """y is the offset along x and z in scene units, and the angle in radians."""
    return scene_task(
        full,
        name="bunny",
        title=TITLE,
        scene=scene,
        params={
            "bunny.translate": lambda y: jnp.array([y[0], 0.0, y[1]]),
            "bunny.rotate": lambda y: y[2],
        },
        reference=[0.2, -0.15, 0.5],
        bounds=([-1.0, -1.0, -1.2], [1.0, 1.0, 1.2]),
        start_box=([-0.6, -0.5, -0.4], [0.6, 0.5, 1.1]),
        sigma=0.25,
        budget=Budget(evaluations=800, seconds=60),
        ad_integrator=DIRECT_AD,
    )


def scene(world: Any) -> dict[str, Any]:
    """The body in the middle of the picture, looking into the camera."""
    return {
        "type": "scene",
        "integrator": DIRECT,
        "camera": camera(world, CAMERA, target=(0, 0, 0.2), fov=28),
        "lamp": flash(CAMERA, power=80),
        "bunny": mesh("bunny", *body(), paint(0.7, 0.6, 0.5)),
    }


def body(level: int = 2) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """A sphere with bulges."""
    directions, faces = icosphere(level)
    radius = np.full(len(directions), 0.8)
    for direction, height, narrow in BULGES:
        cosine = directions @ (np.asarray(direction) / np.linalg.norm(direction))
        radius += height * np.exp(narrow * (cosine - 1))
    return radius[:, None] * directions, faces
