"""README's picture, `python docs/images/strip.py`: a ball, found by its picture."""

from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import mitsuba as mi
import numpy as np

import smoothdiff as sd
from smoothdiff.renderers import mitsuba

SHOWN = (10, 20, 40)
# of the ball in scene units: to the right, away from the camera, up
SOUGHT, START = jnp.array([0.9, 0.2, 0.0]), jnp.array([-0.6, -1.2, 0.8])
BOUNDS = jnp.array([-2.0, -2.0, 0.0]), jnp.array([2.0, 1.0, 2.0])


def scene() -> dict:
    """A floor, a wall, a block, and a ball that rests on the floor."""
    mi.set_variant("scalar_rgb")
    world, up = mi.ScalarTransform4f(), [0, 0, 1]
    paint = lambda *rgb: {"type": "diffuse", "reflectance": {"type": "rgb", "value": rgb}}
    look = world.look_at(origin=[0, -7, 3.5], target=[0, 0, 0.5], up=up)
    block = world.translate([-1.5, 0.9, 0.6]).rotate(up, 30).scale([0.5, 0.5, 0.6])
    return {
        "type": "scene",
        "integrator": {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0},
        "camera": {"type": "perspective", "fov": 32, "to_world": look},
        "floor": {
            "type": "rectangle",
            "to_world": world.scale(5),
            "bsdf": paint(0.8, 0.75, 0.65),
        },
        "wall": {
            "type": "rectangle",
            "to_world": world.translate([0, 2, 0]).rotate([1, 0, 0], 90).scale(5),
            "bsdf": paint(0.35, 0.55, 0.6),
        },
        "block": {"type": "cube", "to_world": block, "bsdf": paint(0.85, 0.65, 0.2)},
        "ball": {
            "type": "sphere",
            "center": [0, 0, 0.5],
            "radius": 0.5,
            "bsdf": paint(0.8, 0.2, 0.12),
        },
        "lamp": {
            "type": "point",
            "position": [-1.5, -2.5, 4],
            "intensity": {"type": "rgb", "value": 45},
        },
    }


def main() -> None:
    """Searches in pictures of 32 x 32 pixels, and draws finer ones."""
    coarse = mitsuba.renderer(scene(), "ball.translate", resolution=32, spp=4)
    fine = mitsuba.renderer(scene(), "ball.translate", resolution=256, spp=64)
    result = sd.least_squares(
        lambda y, photo: coarse(y) - photo,
        START,
        coarse(SOUGHT),
        key=jax.random.key(0),
        bounds=BOUNDS,
    )
    shown = {"start": START}
    for n in SHOWN:
        shown[f"after {n} renders"] = [r.y for r in result.history if r.evaluations <= n][-1]
    shown["photograph"] = SOUGHT
    figure, axes = plt.subplots(
        1, len(shown), figsize=(2.1 * len(shown), 2.4), layout="constrained"
    )
    for axis, (title, y) in zip(axes, shown.items(), strict=True):
        axis.imshow(np.clip(fine(jnp.asarray(y)), 0, 1) ** (1 / 2.2))
        axis.set_title(title, fontsize=11)
        axis.axis("off")
    figure.savefig(Path(__file__).with_name("strip.png"), dpi=90)
    print(result.y, result.evaluations, result.reason)


if __name__ == "__main__":
    main()
