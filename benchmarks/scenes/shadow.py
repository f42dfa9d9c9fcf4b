"""The scene of Shadow: a floor, and a sphere outside the picture that casts its shadow into it.

A camera looks down at the floor; a lamp shines from the upper left, past the sphere, which hangs
left of the picture and moves along x and z. Where its shadow does not touch the reference's, the
loss is a plateau.

There are two unknowns, as the height can hardly be told from the picture: moved along a ray of the
lamp, the sphere changes the size of its shadow and nothing else. In three unknowns, the Hessian of
the smoothed loss at the reference (sigma 0.1 to 0.3) has an eigenvalue along that ray that is zero
within its standard error, 1/50 of the others; in x and z its eigenvalues are a factor of 2 apart.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

from benchmarks.scenes.mitsuba_scene import DIRECT, VARIANT, Description, Picture, picture, rgb

LAMP = (-16.0, 24.0, 12.0)
LAMP_RADIUS = 0.2  # Mitsuba's own AD does not see the shadow's edge if the lamp is a point
SPHERE = (-4.0, 6.0, 3.0)  # on the line from the lamp to the middle of the picture
RADIUS = 0.35

# y is the sphere's offset from there along x and z, in scene units. A shadow is 0.7 wide in y.
PARAMS = {"ball.translate": lambda y: jnp.insert(y, 1, 0.0)}
REFERENCE = np.array([0.45, -0.35], np.float32)
BOUNDS = (np.full(2, -1, np.float32), np.full(2, 1, np.float32))  # shadow at least partly visible
START_BOX = (np.array([-0.7, -0.6], np.float32), np.array([0.0, 0.8], np.float32))
SIGMA = 0.3


def scene(world: Any) -> Description:
    """The scene with the sphere at `SPHERE`."""
    radiance = 3600.0 / (np.pi * LAMP_RADIUS**2)
    return {
        "type": "scene",
        "integrator": DIRECT,  # the lamp is so small that there is no noise but at shadows' edges
        "camera": {
            "type": "perspective",
            "fov": 16,
            "to_world": world.look_at(origin=[0, 10, 9], target=[0, 0, 0], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "pixel_format": "rgb", "rfilter": {"type": "box"}},
        },
        "floor": {
            "type": "rectangle",
            "to_world": world.rotate([1, 0, 0], -90).scale(20),
            "bsdf": {"type": "diffuse", "reflectance": rgb(0.8, 0.7, 0.6)},
        },
        "ball": {"type": "sphere", "center": SPHERE, "radius": RADIUS},
        "lamp": {
            "type": "sphere",
            "center": LAMP,
            "radius": LAMP_RADIUS,
            "emitter": {"type": "area", "radiance": rgb(radiance, radiance, radiance)},
        },
    }


def make(resolution: int, spp: int, variant: str = VARIANT) -> tuple[Picture, np.ndarray]:
    """`render(y)`, a black box, and the image at `REFERENCE` with many samples and other noise.

    A side of the picture has 32 pixels, or 64 in the full task; four samples of each are enough.
    """
    render = picture(scene, PARAMS, variant, resolution=resolution, spp=spp)
    photograph = picture(scene, PARAMS, variant, resolution=resolution, spp=256, seed=1)
    return render, np.asarray(photograph(jnp.asarray(REFERENCE)))
