"""Mug: how far is a mug turned, if all that tells is its handle?

After the Mug task of higher-order differentiable rendering (section 4.1). At 0 the handle is behind
the mug and cannot be seen: the loss is a plateau there. It is almost one wherever the handle is
seen, but does not touch where it is in the photograph.

Left out: all light but that of one point at the camera: no noise and no shadows. The mug is a
cylinder that is never updated, as it is round: only its handle moves.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks._task import Budget
from benchmarks.scenes.meshes import Faces, Positions
from benchmarks.scenes.mitsuba_scene import DIRECT_AD, Description, flashed, mesh, paint
from benchmarks.tasks._scene_task import scene_entry

CAMERA = (0, -8, 3)
HEIGHT = 2.2  # its radius is 1
ATTACHED = 0.95  # of the middle of the handle, from the mug's axis
RING, TUBE = 0.6, 0.16  # radii of the handle
AROUND, ALONG = 12, 32  # a coarse tube has edges that Mitsuba's own AD misses


def scene(world: Any) -> Description:
    """The mug with its handle behind it."""
    white = paint(0.8, 0.75, 0.7)
    return flashed(world, CAMERA, target=(0, 0, 1), fov=28, power=80) | {
        "wall": {"type": "cylinder", "p0": [0, 0, 0], "p1": [0, 0, HEIGHT], "bsdf": white},
        "bottom": {"type": "disk", "to_world": world.translate([0, 0, 0.1]), "bsdf": white},
        "handle": mesh("handle", *handle(), white),
    }


def handle() -> tuple[Positions, Faces]:
    """Half a ring in the plane of y and z, whose ends are in the wall of the mug."""
    along, around = np.meshgrid(
        np.linspace(-np.pi / 2, np.pi / 2, ALONG + 1),
        np.linspace(0, 2 * np.pi, AROUND, endpoint=False),
        indexing="ij",
    )
    radius = RING + TUBE * np.cos(around)
    x, y, z = TUBE * np.sin(around), radius * np.cos(along), radius * np.sin(along)
    positions = np.stack([x, ATTACHED + y, HEIGHT / 2 + z], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(ALONG), np.arange(AROUND), indexing="ij")
    corner = lambda i, j: np.ravel(AROUND * i + j % AROUND)
    a, b, c, d = corner(i, j), corner(i, j + 1), corner(i + 1, j + 1), corner(i + 1, j)
    return positions, np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])


def move_of_handle(y: Float[Array, "1"]) -> Float[Array, "3"]:
    """How far its own middle moves when the handle turns about the axis of the mug."""
    radius = ATTACHED + (RING + TUBE) / 2
    return radius * jnp.array([-jnp.sin(y[0]), jnp.cos(y[0]) - 1, 0.0])


# y is the angle in radians
TURNED = {"handle.rotate": lambda y: y[0], "handle.translate": move_of_handle}

TASKS = scene_entry(
    "mug",
    "Mug: rotation, told by the handle",
    parameters=1,
    plateaus=True,
    scene=scene,
    params=TURNED,
    reference=[-1.8],
    bounds=([-3.1], [3.1]),
    start_box=([-0.6], [1.4]),
    sigma=0.8,
    budget=Budget(evaluations=400, seconds=30),
    ad_integrator=DIRECT_AD,
)
