"""Occlusion: where is a ball that a pillar hides at the start?

After the occlusion task of plateau-reduced differentiable path tracing. While the ball is hidden
the picture does not change at all, so the loss is a plateau in the strict sense.

Left out: all light but that of one point at the camera, so that there is no noise and no shadow
gives the ball away.
"""

from typing import Any

import jax.numpy as jnp

from benchmarks._task import Budget, Task
from benchmarks.scenes._mitsuba_task import DIRECT, DIRECT_AD, camera, flash, paint, scene_task

TITLE = "Occlusion: position of a ball behind a pillar"

CAMERA = (0, -10, 0)


def build(full: bool) -> Task:
    """y is the offset along x and z in scene units. The ball is 1.6 wide."""
    return scene_task(
        full,
        name="occlusion",
        title=TITLE,
        scene=scene,
        params={"ball.translate": lambda y: jnp.array([y[0], 0.0, y[1]])},
        reference=[1.9, 0.4],
        bounds=([-2.5, -1.5], [2.5, 1.5]),
        start_box=([-0.5, -0.7], [0.5, 1.3]),
        sigma=0.8,
        budget=Budget(evaluations=600, seconds=45),
        ad_integrator=DIRECT_AD,
    )


def scene(world: Any) -> dict[str, Any]:
    """The pillar in the middle, the ball behind it."""
    return {
        "type": "scene",
        "integrator": DIRECT,
        "camera": camera(world, CAMERA, target=(0, 0, 0), fov=30),
        "lamp": flash(CAMERA, power=120),
        "wall": {
            "type": "rectangle",
            "to_world": world.translate([0, 4, 0]).rotate([1, 0, 0], 90).scale(8),
            "bsdf": paint(0.5, 0.5, 0.55),
        },
        "pillar": {
            "type": "cylinder",
            "p0": [0, -2, -4],
            "p1": [0, -2, 4],
            "radius": 1.2,
            "bsdf": paint(0.6, 0.6, 0.5),
        },
        "ball": {"type": "sphere", "radius": 0.8, "bsdf": paint(0.8, 0.2, 0.1)},
    }
