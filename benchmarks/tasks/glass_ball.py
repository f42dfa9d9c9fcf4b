"""Glass ball: what is the tint of a ball of glass, and its index of refraction?

After the BRDF task of ZeroGrads (section 4.3.1): colour and index of refraction of a material,
under light from an environment. Glass shows the environment upside down and displaced, so that the
index moves the edges in the picture; Mitsuba's own AD does not know of it (see there, Fig. 12).

Left out: light that is reflected inside the ball, which is paths of more than three bounces. By
chance light is reflected or refracted, which is noise: hence 9 samples, not 4.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from benchmarks._task import Budget
from benchmarks.scenes.mitsuba_scene import Description, camera, rgb
from benchmarks.tasks._scene_task import scene_entry


def scene(world: Any) -> Description:
    """The ball in the middle of a room that is painted on its walls."""
    import mitsuba as mi

    glass = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
    upright = world.rotate([1, 0, 0], 90)
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4},
        "camera": camera(world, origin=(0, -6, 0), target=(0, 0, 0), fov=24),
        "room": {"type": "envmap", "bitmap": mi.Bitmap(environment()), "to_world": upright},
        "ball": {"type": "sphere", "bsdf": glass | {"specular_transmittance": rgb(1, 1, 1)}},
    }


def environment() -> Float[np.ndarray, "height width 3"]:
    """Squares, brighter towards the top, with colours that change around."""
    height, width = 64, 128
    row, column = np.meshgrid(np.arange(height), np.arange(width), indexing="ij")
    squares = 0.3 + 0.7 * ((row // 8 + column // 8) % 2)
    turn = 2 * np.pi * (column[..., None] / width + np.array([0, 1 / 3, 2 / 3]))
    colours = (1.5 - row[..., None] / height) * (0.7 + 0.3 * np.cos(turn))
    return (squares[..., None] * colours).astype(np.float32)


TASKS = scene_entry(
    "glass-ball",
    "Glass ball: tint and index of refraction",
    parameters=4,
    plateaus=False,
    scene=scene,
    # y is red, green and blue of the tint, and the index of refraction less one
    params={
        "ball.bsdf.specular_transmittance.value": lambda y: y[:3],
        "ball.bsdf.eta": lambda y: 1 + y[3],
    },
    reference=[0.85, 0.6, 0.35, 0.5],
    bounds=([0.0, 0.0, 0.0, 0.05], [1.0, 1.0, 1.0, 1.0]),
    start_box=([0.1, 0.1, 0.1, 0.1], [0.9, 0.9, 0.9, 0.9]),
    sigma=0.2,
    budget=Budget(evaluations=800, seconds=60),
    spp=9,
)
