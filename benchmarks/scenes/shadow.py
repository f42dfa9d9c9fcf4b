"""Shadow: where is a sphere that is outside the picture, given the shadow that it casts into it?

After the Shadow task of higher-order differentiable rendering (section 4.1). A camera looks down at
a floor; a lamp shines from the upper left, past a sphere that hangs left of the picture and moves
along x and z. Where its shadow does not touch the reference's, the loss is a plateau.

There are two unknowns, as the height can hardly be told from the picture: moved along a ray of the
lamp, the sphere changes the size of its shadow and nothing else. In three unknowns, the Hessian of
the smoothed loss at the reference (sigma 0.1 to 0.3) has an eigenvalue along that ray that is zero
within its standard error, 1/50 of the others; in x and z its eigenvalues are a factor of 2 apart.
"""

import zlib
from collections.abc import Callable
from typing import Any

import drjit as dr
import jax.numpy as jnp
import mitsuba as mi
import numpy as np
from jaxtyping import Array, Float

from smoothdiff.renderers import mitsuba
from smoothdiff.renderers._mitsuba_scene import mitsuba_with

LAMP = (-16.0, 24.0, 12.0)
LAMP_RADIUS = 0.2  # Mitsuba's own AD does not see the shadow's edge if the lamp is a point
SPHERE = (-4.0, 6.0, 3.0)  # on the line from the lamp to the middle of the picture
RADIUS = 0.35

# y is the sphere's offset from there along x and z, in scene units. A shadow is 0.7 wide in y.
REFERENCE = np.array([0.45, -0.35], np.float32)
BOUNDS = (np.full(2, -1, np.float32), np.full(2, 1, np.float32))  # shadow at least partly visible
START_BOX = (np.array([-0.7, -0.6], np.float32), np.array([0.0, 0.8], np.float32))
SIGMA = 0.3


def scene_dict(resolution: int) -> dict[str, Any]:
    """The scene with the sphere at `SPHERE`, for `mitsuba.load_dict`."""
    if mi.variant() is None:  # transforms cannot be made before
        mi.set_variant("scalar_rgb")
    transform = mi.ScalarTransform4f()
    radiance = 3600.0 / (np.pi * LAMP_RADIUS**2)
    return {
        "type": "scene",
        # A lamp so small is met by sampling the lamp only: no noise but at the shadow's edge.
        "integrator": {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0},
        "camera": {
            "type": "perspective",
            "fov": 16,
            "to_world": transform.look_at(origin=[0, 10, 9], target=[0, 0, 0], up=[0, 1, 0]),
            "film": {
                "type": "hdrfilm",
                "width": resolution,
                "height": resolution,
                "pixel_format": "rgb",
                "rfilter": {"type": "box"},
            },
        },
        "floor": {
            "type": "rectangle",
            "to_world": transform.rotate([1, 0, 0], -90).scale(20),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.7, 0.6]}},
        },
        "ball": {"type": "sphere", "center": SPHERE, "radius": RADIUS},
        "lamp": {
            "type": "sphere",
            "center": LAMP,
            "radius": LAMP_RADIUS,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance}},
        },
    }


def make(
    resolution: int, spp: int, variant: str = "scalar_rgb"
) -> tuple[Callable[[Float[Array, "2"]], Float[Array, "height width 3"]], np.ndarray]:
    """The render function and the reference image.

    Args:
        resolution: Pixels along a side; 32 is quick, 64 is the full task.
        spp: Samples per pixel; 4 are enough.
        variant: Mitsuba variant.

    Returns:
        `render(y)`, a black box, and the image at `REFERENCE` with many samples and other noise.
    """
    scene = scene_dict(resolution)
    ball = mitsuba.renderer(scene, "ball.translate", spp=spp, variant=variant)
    photograph = mitsuba.renderer(scene, "ball.translate", spp=256, variant=variant, seed=1)

    def render(y: Float[Array, "2"]) -> Float[Array, "height width 3"]:
        return ball(jnp.insert(y, 1, 0.0))

    return render, np.asarray(photograph(jnp.insert(jnp.asarray(REFERENCE), 1, 0.0)))


def native_ad(
    resolution: int, spp: int, photograph: np.ndarray, variant: str
) -> Callable[[Float[Array, "2"]], tuple[Float[Array, ""], Float[Array, "2"]]]:
    """The loss and its gradient by Mitsuba's own AD, with the term that moving edges need.

    Args:
        resolution: Pixels along a side.
        spp: Samples per pixel.
        photograph: The image to be matched, as `make` returns it.
        variant: A variant that has AD, such as `"llvm_ad_rgb"`.

    Returns:
        `y -> (loss, gradient)`, not to be traced by JAX.
    """
    with mitsuba_with(variant):
        description = scene_dict(resolution)
        description["camera"]["film"]["sample_border"] = True  # for edges that enter the picture
        description["integrator"] = {"type": "direct_projective"}
        scene = mi.load_dict(description, optimize=False)
        parameters = mi.traverse(scene)

    def value_and_grad(y: Float[Array, "2"]) -> tuple[Float[Array, ""], Float[Array, "2"]]:
        with mitsuba_with(variant):
            x, z = (mi.Float(offset) for offset in y.tolist())
            dr.enable_grad(x, z)
            centre = mi.Point3f(SPHERE[0] + x, SPHERE[1], SPHERE[2] + z)
            parameters["ball.to_world"] = mi.Transform4f().translate(centre).scale(RADIUS)
            parameters.update()
            seed: Any = zlib.crc32(np.asarray(y).tobytes())  # other noise in each iteration
            image = mi.render(scene, parameters, spp=spp, seed=seed)
            loss = dr.mean(dr.square(image - mi.TensorXf(photograph)), axis=None)
            dr.backward(loss)
            gradient = np.concatenate([dr.grad(x).numpy(), dr.grad(z).numpy()])
            return jnp.asarray(loss.numpy()), jnp.asarray(gradient)

    return value_and_grad
