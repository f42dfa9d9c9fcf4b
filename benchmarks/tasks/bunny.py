"""A body with two ears: where is it, and how far is it turned about the vertical?

`bunny`: after the Bunny task of higher-order differentiable rendering (section 4.1). As there, it
is set up for the renderer's own AD: the body always overlaps the one in the photograph, and no
start is on a plateau.

`mirror`: after the two-bounce experiment there (appendix K). The camera looks into a mirror that
looks up into another one, which looks at the body, as in a periscope. Where the body does not touch
the one in the photograph, the loss is almost flat. Mitsuba's own AD misses edges that are seen over
mirrors.

Left out: all light but that of one point, so that shading has no noise and, with the lamp at the
camera of `bunny`, no shadows; and paths of more than the three bounces that reach the body. The
mesh has 162 vertices, as normals that are interpolated make it smooth.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

from benchmarks._task import Budget
from benchmarks.scenes.meshes import Faces, Positions, icosphere
from benchmarks.scenes.mitsuba_scene import (
    DIRECT_AD,
    Description,
    camera,
    flash,
    flashed,
    mesh,
    paint,
)
from benchmarks.tasks._scene_task import scene_entry

BROWN = (0.7, 0.6, 0.5)
# where the body bulges: direction, how far, and how narrow
BULGES = (
    ((0.55, 0.0, 1.0), 1.0, 14.0),  # ears
    ((-0.55, 0.0, 1.0), 1.0, 14.0),
    ((0.0, -1.0, 0.2), 0.5, 6.0),  # nose
    ((0.0, 1.0, -0.6), 0.25, 8.0),  # tail
)
# from the camera to the first mirror, up to the second, and on to the body
DISTANCE, HEIGHT, BEYOND = 2.5, 2.6, 3.7


def body() -> tuple[Positions, Faces]:
    """A sphere with bulges."""
    directions, faces = icosphere(2)
    radius = np.full(len(directions), 0.8)
    for direction, height, narrow in BULGES:
        cosine = directions @ (np.asarray(direction) / np.linalg.norm(direction))
        radius += height * np.exp(narrow * (cosine - 1))
    return radius[:, None] * directions, faces


def before_the_camera(world: Any) -> Description:
    """The body in the middle of the picture, looking into the camera."""
    shown = {"bunny": mesh("bunny", *body(), paint(*BROWN))}
    return flashed(world, (0, -8, 0.8), target=(0, 0, 0.2), fov=28, power=80) | shown


def over_mirrors(world: Any) -> Description:
    """The body in the middle of the picture."""
    silver = {"type": "twosided", "bsdf": {"type": "conductor", "material": "none"}}

    def mirror(height: float) -> Description:
        to_world = world.translate([0, DISTANCE, height]).rotate([1, 0, 0], 45).scale(2.5)
        return {"type": "rectangle", "to_world": to_world, "bsdf": silver}

    positions, faces = body()
    place = np.array([0, DISTANCE + BEYOND, HEIGHT])
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4},
        "camera": camera(world, origin=(0, 0, 0), target=(0, 1, 0), fov=34),
        "lamp": flash((0, DISTANCE + 0.5, HEIGHT), power=12),
        "first": mirror(0.0),
        "second": mirror(HEIGHT),
        "bunny": mesh("bunny", positions + place, faces, paint(*BROWN)),
    }


# y is the offset in the plane of the picture, in scene units, and the angle in radians
TASKS = scene_entry(
    "bunny",
    "Bunny: position and rotation",
    parameters=3,
    plateaus=False,
    scene=before_the_camera,
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
) | scene_entry(
    "mirror",
    "Mirror: a body seen over two mirrors",
    parameters=3,
    plateaus=True,
    scene=over_mirrors,
    # the offset is along the floor: mirrors show it as one in the plane of the picture
    params={
        "bunny.translate": lambda y: jnp.array([y[0], y[1], 0.0]),
        "bunny.rotate": lambda y: y[2],
    },
    reference=[0.9, 0.2, 0.4],
    bounds=([-2.0, -1.0, -1.2], [2.0, 1.2, 1.2]),
    start_box=([-1.5, -0.8, -0.8], [0.2, 0.8, 0.8]),
    sigma=0.4,
    budget=Budget(evaluations=800, seconds=60),
)
