"""Scenes of Mitsuba: parts to describe one with, and its picture as a function of y.

A picture has the same noise at every call. Mitsuba is imported when one is asked for.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Array, Float, Int

# the same pictures on every machine; with so few pixels it is as fast as any other variant
VARIANT = "scalar_rgb"
UP = (0, 0, 1)  # what objects turn about that turn

Description: TypeAlias = dict[str, Any]  # for mitsuba.load_dict
Describe: TypeAlias = Callable[
    [Any], Description
]  # given an identity transform to make others from
# by name, as for `smoothdiff.renderers.mitsuba.renderer`: its value, of y
Params: TypeAlias = Mapping[str, Callable[[Array], Array]]
Picture: TypeAlias = Callable[[Array], Float[Array, "height width 3"]]

# for a scene with one lamp that is a point: no noise, and no edges of shadows that AD could see
DIRECT = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}
DIRECT_AD = {"type": "direct_projective", "sppi": 0}
# light that bounces once
PATHS = {"type": "path", "max_depth": 3}
PATHS_AD = {"type": "prb_projective", "max_depth": 3, "guiding": "none"}


def picture(scene: Describe, params: Params, variant: str = VARIANT, **settings: Any) -> Picture:
    """The picture of a scene as a function of y, a black box.

    Each has a scene of its own, as meshes would be moved for all that share them.

    Args:
        scene: Describes the scene.
        params: What is varied.
        variant: Of Mitsuba.
        settings: `resolution`, `spp`, `seed` and `integrator`, as for the renderer.
    """
    import mitsuba as mi

    from smoothdiff.renderers import mitsuba

    mi.set_variant(variant)  # transforms cannot be made before
    described = scene(mi.ScalarTransform4f())
    render = mitsuba.renderer(described, list(params), axis=UP, variant=variant, **settings)
    return lambda y: render({key: value(y) for key, value in params.items()})


def camera(world: Any, origin: Sequence[float], target: Sequence[float], fov: float) -> Description:
    """A camera, upright along z, of any resolution, whose samples are spread evenly."""
    return {
        "type": "perspective",
        "fov": fov,
        "to_world": world.look_at(origin=origin, target=target, up=UP),
        "film": {"type": "hdrfilm", "pixel_format": "rgb", "rfilter": {"type": "box"}},
        "sampler": {"type": "stratified"},
    }


def flash(at: Sequence[float], power: float) -> Description:
    """A lamp that is a point, for shading without noise. At the camera it shows no shadows."""
    return {"type": "point", "position": list(at), "intensity": rgb(power, power, power)}


def flashed(
    world: Any, at: Sequence[float], target: Sequence[float], fov: float, power: float
) -> Description:
    """A scene with nothing but a camera and its flash."""
    view, lamp = camera(world, at, target, fov), flash(at, power)
    return {"type": "scene", "integrator": DIRECT, "camera": view, "lamp": lamp}


def paint(red: float, green: float, blue: float) -> Description:
    """A matt surface, seen from both sides."""
    matt = {"type": "diffuse", "reflectance": rgb(red, green, blue)}
    return {"type": "twosided", "bsdf": matt}


def rgb(red: float, green: float, blue: float) -> Description:
    """A colour, linear."""
    return {"type": "rgb", "value": [red, green, blue]}


def mesh(
    name: str,
    positions: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    bsdf: Description,
) -> Any:
    """A smooth mesh, in Mitsuba's variant of now. It takes the name that it has in the scene."""
    import mitsuba as mi

    props: Any = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    made = mi.Mesh(name, len(positions), len(faces), has_vertex_normals=True, props=props)
    parameters = mi.traverse(made)
    parameters["vertex_positions"] = np.ravel(positions).astype(np.float32)
    parameters["faces"] = np.ravel(faces).astype(np.uint32)
    parameters.update()
    return made
