"""Global illumination: where is a red box beside the picture? Only its bounce light is seen.

After the task of that name of plateau-reduced differentiable path tracing. What is in the picture
lies in the shade of a roof; the sun shines on the box, and all light in the picture comes from it.
Where the box is far, little changes: the loss is almost flat.

Left out: all paths but those of one bounce. Bounce light is smooth, but noisy: hence 64 samples in
8 x 8 pixels.
"""

from typing import Any

import jax.numpy as jnp

from benchmarks._task import Budget
from benchmarks.scenes.mitsuba_scene import PATHS, PATHS_AD, Description, camera, paint, rgb
from benchmarks.tasks._scene_task import scene_entry


def scene(world: Any) -> Description:
    """Floor, wall and roof end right of the picture, where the box stands."""
    grey = paint(0.8, 0.8, 0.8)
    level = world.translate([-2.1, 0, 0]).scale([3, 3, 1])
    upright = world.translate([-2.1, 1.5, 1.5]).rotate([1, 0, 0], 90).scale([3, 1.5, 1])
    box = world.translate([1.8, 0, 1.5]).scale([0.3, 0.9, 1.5])
    return {
        "type": "scene",
        "integrator": PATHS,
        "camera": camera(world, origin=(-0.5, -8, 2), target=(-0.2, 0.5, 0.8), fov=14),
        "floor": {"type": "rectangle", "to_world": level, "bsdf": grey},
        "wall": {"type": "rectangle", "to_world": upright, "bsdf": grey},
        "roof": {"type": "rectangle", "to_world": world.translate([0, 0, 3]) @ level, "bsdf": grey},
        "box": {"type": "cube", "to_world": box, "bsdf": paint(0.9, 0.25, 0.1)},
        "sun": {"type": "directional", "direction": [0.2, 0, -1], "irradiance": rgb(50, 50, 50)},
    }


TASKS = scene_entry(
    "global-illumination",
    "Global illumination: an object seen by its bounce light",
    parameters=2,
    plateaus=True,
    scene=scene,
    # y is the offset along x and y in scene units; the box is 1.8 long
    params={"box.translate": lambda y: jnp.array([y[0], y[1], 0.0])},
    reference=[0.3, 0.3],
    bounds=([0.0, -1.5], [2.5, 1.5]),
    start_box=([0.8, -1.4], [2.2, 0.0]),
    sigma=0.4,
    budget=Budget(evaluations=600, seconds=60),
    resolution=8,
    spp=64,
    ad_integrator=PATHS_AD,
)
