"""Texture32: the 1,024 texels of a poster that is seen at an angle; Mitsuba 3 as a black box.

After the Texture task of higher-order differentiable rendering (section 4.1). Texels mix in pixels
and nothing else happens, so no plateau hides them: what is hard is that there are many. A pixel
sees a few texels, and the support says which.

Left out: all light but that of one point, and a texel is not mixed with its neighbours. Samples are
spread evenly in a pixel, or four of them would not tell where the edge of a texel is.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

import smoothdiff as sd
from benchmarks._task import Budget, Task, entry
from benchmarks.scenes.mitsuba_scene import DIRECT, Description, camera, flash
from benchmarks.tasks._scene_task import scene_task

SIDE = 32  # texels
TILT = 30.0  # degrees, of the poster [-1, 1]², whose lower edge is the nearer one
DISTANCE, FIELD = 4.2, 31.0  # of the camera from the middle; degrees


def build(full: bool, **named: Any) -> Task:
    """Starts are noise. Quick: 48 x 48 pixels; full: 64 x 64. y are the texels, row by row."""
    resolution, size = 64 if full else 48, SIDE**2
    return scene_task(
        full,
        scene=scene,
        params={"poster.bsdf.reflectance.data": lambda y: y.reshape(SIDE, SIDE, 1)},
        reference=texture().ravel(),
        bounds=([0.0] * size, [1.0] * size),
        start_box=([0.1] * size, [0.9] * size),
        sigma=0.2,  # of grey
        budget=Budget(20_000, 600) if full else Budget(4000, 120),
        seeds=(2, 10),
        resolution=resolution,
        support=support(resolution),
        **named,
    )


def scene(world: Any) -> Description:
    """The poster, grey, before a camera that looks at its middle."""
    import mitsuba as mi

    grey = mi.Bitmap(np.full((SIDE, SIDE, 1), 0.5, np.float32))
    texels = {"type": "bitmap", "bitmap": grey, "filter_type": "nearest", "raw": True}
    return {
        "type": "scene",
        "integrator": DIRECT,
        "camera": camera(world, (0, -DISTANCE, 0), (0, 0, 0), FIELD),
        "lamp": flash((0.5, -4, 1), 50),
        "poster": {
            "type": "rectangle",
            "to_world": world.rotate([1, 0, 0], 90 - TILT),
            "bsdf": {"type": "diffuse", "reflectance": texels},
        },
    }


def texture() -> Float[np.ndarray, "32 32"]:
    """What is sought: a disc and a bar before stripes, every value within the starts' range."""
    y, x = np.mgrid[:SIDE, :SIDE] + 0.5
    stripes = np.where((x + y) // 5 % 2 == 0, 0.35, 0.2 + 0.3 * y / SIDE)
    disc = np.hypot(x - 11.5, y - 19.5) < 8
    found = np.where(disc, 0.85 - 0.03 * np.hypot(x - 8.5, y - 16.5), stripes)
    return np.where((np.abs(y - 7) < 3) & (np.abs(x - 20) < 9), 0.15, found)


def support(resolution: int):
    """Which pixels a texel may change: those whose footprint on the poster meets it.

    The footprint is the box around where the corners of the pixel are on the poster.
    """
    line = np.tan(np.radians(FIELD / 2)) * (2 * np.arange(resolution + 1) / resolution - 1)
    x, y = np.meshgrid(line, -line)
    sin, cos = np.sin(np.radians(TILT)), np.cos(np.radians(TILT))
    up = DISTANCE * y / (cos - y * sin)  # along the poster, from its middle
    across = x * (DISTANCE + up * sin)
    row, column = _meets(SIDE * (1 + up) / 2), _meets(SIDE * (1 + across) / 2)
    meets = row[:, :, :, None] & column[:, :, None]  # the first row of texels is the nearest
    return sd.matrix_support(meets.reshape(-1, SIDE**2), (resolution, resolution))


def _meets(corners: np.ndarray) -> np.ndarray:
    """(rows, columns, texels) along one axis of the texture, from where pixels have corners."""
    four = np.stack([corners[:-1, :-1], corners[1:, :-1], corners[:-1, 1:], corners[1:, 1:]])
    low, high = np.floor(four.min(0)), np.floor(four.max(0))
    texel = np.arange(SIDE)
    return (low[..., None] <= texel) & (texel <= high[..., None])


TASKS = entry(
    "large",
    build,
    "texture32",
    "Texture32: 1,024 texels of a tilted poster",
    parameters=1_024,
    plateaus=False,
)
