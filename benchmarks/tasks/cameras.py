"""Cameras: from where, in which direction and how wide was a photograph taken?

What users of renderers ask for: Mitsuba's own AD has no derivative of a camera. Every edge in the
picture moves with it.

`camera`: position and direction of a perspective camera, six unknowns. From too far away a tile of
the floor takes the place of its neighbour, which is a local minimum.

`orthographic`: direction, place in its plane and zoom of an orthographic one. How far away it is
cannot be seen.

Left out: all light but that of one lamp far away, without noise; more than one bounce.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks._task import Budget
from benchmarks.scenes.mitsuba_scene import DIRECT, UP, Description, camera, paint, rgb
from benchmarks.tasks._scene_task import scene_entry

ORIGIN, TARGET = (3.5, -5.0, 3.0), (0.0, 0.0, 0.4)
DISTANCE = float(np.linalg.norm(np.subtract(ORIGIN, TARGET)))
# to the right, upwards and forwards, as the camera sees it
FORWARDS = np.subtract(TARGET, ORIGIN) / DISTANCE
RIGHT = np.cross(FORWARDS, UP) / np.linalg.norm(np.cross(FORWARDS, UP))
VIEW = np.stack([RIGHT, np.cross(RIGHT, FORWARDS), FORWARDS]).astype(np.float32)


def still_life(world: Any) -> Description:
    """A floor of coloured tiles, and on it three things of different height."""
    import mitsuba as mi

    tiles = {"type": "bitmap", "bitmap": mi.Bitmap(floor()), "raw": True}
    lamp = {"type": "directional", "direction": [-0.3, 0.6, -1.0], "irradiance": rgb(3, 3, 3)}
    return {
        "type": "scene",
        "integrator": DIRECT,
        "camera": camera(world, ORIGIN, TARGET, fov=40),
        "lamp": lamp,
        "floor": {
            "type": "rectangle",
            "to_world": world.scale(6),
            "bsdf": {"type": "diffuse", "reflectance": tiles},
        },
        "ball": {
            "type": "sphere",
            "center": [0.9, 0.5, 0.6],
            "radius": 0.6,
            "bsdf": paint(0.9, 0.3, 0.2),
        },
        "box": {
            "type": "cube",
            "to_world": world.translate([-0.8, 0.3, 0.8]).rotate(UP, 25).scale([0.4, 0.4, 0.8]),
            "bsdf": paint(0.2, 0.5, 0.9),
        },
        "post": {
            "type": "cylinder",
            "p0": [0.2, -1.2, 0],
            "p1": [0.2, -1.2, 1.1],
            "radius": 0.25,
            "bsdf": paint(0.9, 0.8, 0.2),
        },
    }


def from_afar(world: Any) -> Description:
    """The same, by an orthographic camera."""
    scene = still_life(world)
    view = camera(world, ORIGIN, TARGET, fov=40)
    parallel = {"to_world": view["to_world"] @ world.scale([2.2, 2.2, 1.0])}
    del view["fov"]
    return scene | {"camera": view | {"type": "orthographic"} | parallel}


def floor() -> Float[np.ndarray, "tiles tiles 3"]:
    """Tiles of random colours, the same ones each time."""
    return np.random.default_rng(0).uniform(0.1, 0.9, (8, 8, 3)).astype(np.float32)


def in_world(seen: Float[Array, "3"]) -> Float[Array, "3"]:
    """A vector whose entries are to the right, upwards and forwards."""
    return jnp.asarray(seen) @ VIEW


# y is the offset in scene units, then the turn in radians times the distance: both move the picture
# as much
POSE = {
    "camera.translate": lambda y: in_world(y[:3]),
    "camera.rotate": lambda y: in_world(y[3:] / DISTANCE),
}
# y is the offset in the plane of the picture, the turn as above, and the logarithm of the zoom
PARALLEL = {
    "camera.translate": lambda y: in_world(jnp.array([y[0], y[1], 0.0])),
    "camera.rotate": lambda y: in_world(y[2:5] / DISTANCE),
    "camera.scale": lambda y: jnp.exp(y[5] / DISTANCE),
}
LIMIT, START = 1.5, 0.5

TASKS = scene_entry(
    "camera",
    "Camera: position and direction, six unknowns",
    parameters=6,
    plateaus=False,
    scene=still_life,
    params=POSE,
    reference=[0.3, -0.2, 0.25, -0.3, 0.2, 0.35],
    bounds=([-LIMIT] * 6, [LIMIT] * 6),
    start_box=([-START] * 6, [START] * 6),
    sigma=0.3,
    budget=Budget(evaluations=1000, seconds=60),
) | scene_entry(
    "orthographic",
    "Orthographic camera: direction, place and zoom",
    parameters=6,
    plateaus=False,
    scene=from_afar,
    params=PARALLEL,
    reference=[0.3, -0.2, -0.3, 0.2, 0.35, 0.4],
    bounds=([-LIMIT] * 6, [LIMIT] * 6),
    start_box=([-START] * 6, [START] * 6),
    sigma=0.3,
    budget=Budget(evaluations=1000, seconds=60),
)
