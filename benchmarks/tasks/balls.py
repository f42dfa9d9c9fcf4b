"""Balls on plateaus: where is a ball that is hidden at the start, and where do four balls belong?

After tasks of plateau-reduced differentiable path tracing.

`occlusion`: a pillar hides the ball. While it is hidden the picture does not change at all, so the
loss is a plateau in the strict sense.

`sort`: with fewer primitives than there. Four coloured balls are to be where the photograph has
them, each in its place. A ball that does not touch its place changes the picture by the same amount
wherever it is, but for what it hides or is hidden by: plateaus in eight dimensions.

Left out: all light but that of one point at the camera, so that shading has no noise, and no shadow
is seen, which would give the hidden ball away.
"""

from typing import Any

import jax.numpy as jnp

from benchmarks._task import Budget
from benchmarks.scenes.mitsuba_scene import DIRECT_AD, Description, flashed, paint
from benchmarks.tasks._scene_task import scene_entry

CAMERA, MIDDLE = (0, -10, 0), (0, 0, 0)
COLOURS = ((0.9, 0.1, 0.1), (0.1, 0.9, 0.1), (0.1, 0.1, 0.9), (0.9, 0.9, 0.9))
PLACES = ((-0.7, 0.7), (0.7, 0.7), (-0.7, -0.7), (0.7, -0.7))


def behind_a_pillar(world: Any) -> Description:
    """The pillar in the middle, the ball behind it."""
    return flashed(world, CAMERA, MIDDLE, fov=30, power=120) | {
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


def unsorted(world: Any) -> Description:
    """All balls in the middle, each at a depth of its own."""
    return flashed(world, CAMERA, MIDDLE, fov=24, power=300) | {
        f"ball{i}": {"type": "sphere", "center": [0, i, 0], "radius": 0.6, "bsdf": paint(*colour)}
        for i, colour in enumerate(COLOURS)
    }


# y is x and z of each ball in scene units, its offset from the middle
TASKS = scene_entry(
    "occlusion",
    "Occlusion: position of a ball behind a pillar",
    parameters=2,
    plateaus=True,
    scene=behind_a_pillar,
    params={"ball.translate": lambda y: jnp.array([y[0], 0.0, y[1]])},
    reference=[1.9, 0.4],
    bounds=([-2.5, -1.5], [2.5, 1.5]),
    start_box=([-0.5, -0.7], [0.5, 1.3]),
    sigma=0.8,
    budget=Budget(evaluations=600, seconds=45),
    ad_integrator=DIRECT_AD,
) | scene_entry(
    "sort",
    "Sort: places of four coloured balls",
    parameters=8,
    plateaus=True,
    scene=unsorted,
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
