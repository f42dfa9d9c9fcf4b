"""Mirror: where is a body, and how far is it turned, if it is only seen over two mirrors?

After the two-bounce experiment of higher-order differentiable rendering (appendix K): position and
rotation about the vertical. The camera looks into a mirror that looks up into another one, which
looks at the body, as in a periscope. Where the body does not touch the one in the photograph, the
loss is almost flat.

Left out: all light but that of one point, so that shading has no noise, and paths of more than the
three bounces that reach the body. Mitsuba's own AD misses edges that are seen over mirrors.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

from benchmarks._task import Budget, Task
from benchmarks.scenes._mitsuba_task import camera, flash, mesh, paint, scene_task
from benchmarks.scenes.bunny import body

TITLE = "Mirror: a body seen over two mirrors"

# from the camera to the first mirror, up to the second, and on to the body
DISTANCE, HEIGHT, BEYOND = 2.5, 2.6, 3.7


def build(full: bool) -> Task:
    """y is the offset along x and y in scene units, and the angle in radians."""
    return scene_task(
        full,
        name="mirror",
        title=TITLE,
        scene=scene,
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


def scene(world: Any) -> dict[str, Any]:
    """The body in the middle of the picture."""
    silver = {"type": "twosided", "bsdf": {"type": "conductor", "material": "none"}}

    def mirror(height: float) -> dict[str, Any]:
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
        "bunny": mesh("bunny", positions + place, faces, paint(0.7, 0.6, 0.5)),
    }
