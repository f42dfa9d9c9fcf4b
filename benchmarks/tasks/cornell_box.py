"""Cornell box: where is the lamp below the ceiling, and how far are the two boxes turned?

After the Cornell box of ZeroGrads (section 4.3.1). The boxes are longer than they are wide, or a
turn by a right angle would look the same. Sides of a box that face away from the camera tell
nothing, and edges of boxes and shadows jump from pixel to pixel.

Left out: the second bounce of light and all later ones, which change the brightness a little and
nothing else; the sight of the lamp, whose few pixels would outshine the picture: the camera is as
high as the lamp, which shines downwards. Light from all over the room is noisy: hence 9 samples,
not 4, in 24 x 24 pixels.
"""

from typing import Any

import jax.numpy as jnp

from benchmarks._task import Budget
from benchmarks.scenes.mitsuba_scene import PATHS, PATHS_AD, Description, camera, paint, rgb
from benchmarks.tasks._scene_task import scene_entry


def scene(world: Any) -> Description:
    """A room from -1 to 1, open towards the camera."""
    white, red, green = paint(0.7, 0.7, 0.7), paint(0.6, 0.07, 0.07), paint(0.12, 0.45, 0.1)

    def wall(colour: Description, axis: list[int], degrees: float) -> Description:
        to_world = world.rotate(axis, degrees).translate([0, 0, -1])
        return {"type": "rectangle", "to_world": to_world, "bsdf": colour}

    def box(
        x: float, y: float, size: tuple[float, float, float], colour: Description
    ) -> Description:
        to_world = world.translate([x, y, size[2] - 1]).scale(size)
        return {"type": "cube", "to_world": to_world, "bsdf": colour}

    down = world.translate([0, -0.5, 0.98]).rotate([1, 0, 0], 180).scale(0.3)
    return {
        "type": "scene",
        "integrator": PATHS,
        "camera": camera(world, origin=(0, -4, 0.99), target=(0, 0, -0.2), fov=34),
        "floor": wall(white, [0, 0, 1], 0),
        "ceiling": wall(white, [1, 0, 0], 180),
        "back": wall(white, [1, 0, 0], 90),
        "left": wall(red, [0, 1, 0], 90),
        "right": wall(green, [0, 1, 0], -90),
        "tall": box(-0.4, 0.3, (0.42, 0.15, 0.65), paint(0.3, 0.4, 0.9)),
        "low": box(0.4, -0.1, (0.42, 0.15, 0.4), paint(0.9, 0.8, 0.3)),
        "lamp": {
            "type": "rectangle",
            "to_world": down,
            "emitter": {"type": "area", "radiance": rgb(14, 12, 9)},
        },
    }


TASKS = scene_entry(
    "cornell-box",
    "Cornell box: lamp and rotations of boxes",
    parameters=4,
    plateaus=True,
    scene=scene,
    # y is the offset of the lamp along x and y in scene units, and two angles in radians
    params={
        "lamp.translate": lambda y: jnp.array([y[0], y[1], 0.0]),
        "tall.rotate": lambda y: y[2],
        "low.rotate": lambda y: y[3],
    },
    reference=[0.2, -0.15, 0.5, -0.45],
    bounds=([-0.6, -0.4, -1.0, -1.0], [0.6, 0.6, 1.0, 1.0]),
    start_box=([-0.5, -0.3, -0.9, -0.9], [0.5, 0.5, 0.9, 0.9]),
    sigma=0.25,
    budget=Budget(evaluations=1000, seconds=90),
    resolution=24,
    spp=9,
    ad_integrator=PATHS_AD,
)
