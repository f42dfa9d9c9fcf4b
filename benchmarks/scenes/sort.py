"""Sort: four coloured balls are to be where the photograph has them, each in its place.

After the sorting task of plateau-reduced differentiable path tracing, with fewer primitives. A ball
that does not touch its place changes the picture by the same amount wherever it is, but for what it
hides or is hidden by: plateaus in eight dimensions.

Left out: all light but that of one point at the camera, so that shading has no noise and balls cast
no shadows that are seen.
"""

from typing import Any

import jax.numpy as jnp

from benchmarks._task import Budget, Task
from benchmarks.scenes._mitsuba_task import DIRECT, DIRECT_AD, camera, flash, paint, scene_task

TITLE = "Sort: places of four coloured balls"

CAMERA = (0, -10, 0)
COLOURS = ((0.9, 0.1, 0.1), (0.1, 0.9, 0.1), (0.1, 0.1, 0.9), (0.9, 0.9, 0.9))
PLACES = ((-0.7, 0.7), (0.7, 0.7), (-0.7, -0.7), (0.7, -0.7))


def build(full: bool) -> Task:
    """y is x and z of each ball in scene units. A ball is 1.2 wide."""
    return scene_task(
        full,
        name="sort",
        title=TITLE,
        scene=scene,
        params={
            f"ball{i}.translate": lambda y, i=i: jnp.array([y[2 * i], 0.0, y[2 * i + 1]])
            for i in range(len(COLOURS))
        },
        reference=[at for place in PLACES for at in place],
        bounds=([-1.4] * 8, [1.4] * 8),
        start_box=([-1.2] * 8, [1.2] * 8),
        sigma=0.6,
        budget=Budget(evaluations=3000, seconds=120),
        ad_integrator=DIRECT_AD,
    )


def scene(world: Any) -> dict[str, Any]:
    """All balls in the middle, each at a depth of its own."""
    balls = {
        f"ball{i}": {
            "type": "sphere",
            "center": [0, i, 0],
            "radius": 0.6,
            "bsdf": paint(*colour),
        }
        for i, colour in enumerate(COLOURS)
    }
    lamp = flash(CAMERA, power=300)
    view = camera(world, CAMERA, target=(0, 0, 0), fov=24)
    return {"type": "scene", "integrator": DIRECT, "camera": view, "lamp": lamp} | balls
