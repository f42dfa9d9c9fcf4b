"""Scenes of Mitsuba: parts to describe one with, and its picture as a function of y.

A picture has the same noise at every call. Mitsuba is imported when one is asked for.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import jax
import numpy as np
from jaxtyping import Array, Float

from benchmarks.scenes.meshes import Faces, Positions
from smoothdiff import Level

# the same pictures on every machine; with so few pixels it is as fast as any other variant
VARIANT = "scalar_rgb"
UP = (0, 0, 1)  # what objects turn about that turn, but for a camera, which turns about any

Description: TypeAlias = dict[str, Any]  # for mitsuba.load_dict
# given an identity transform to make others from
Describe: TypeAlias = Callable[[Any], Description]
# by name, as for `smoothdiff.renderers.mitsuba.renderer`: its value, of y
Params: TypeAlias = Mapping[str, Callable[[Array], Array]]
# of y, and of a key that decides the noise if one is given
Picture: TypeAlias = Callable[..., Float[Array, "height width 3"]]

# for a scene with one lamp that is a point: no noise, and no edges of shadows that AD could see
DIRECT = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}
DIRECT_AD = {"type": "direct_projective", "sppi": 0}
# light that bounces once
PATHS = {"type": "path", "max_depth": 3}
PATHS_AD = {"type": "prb_projective", "max_depth": 3, "guiding": "none"}

SAVINGS = {
    "integrator": "path tracing of depth 8",
    "samples": "4 times the samples",
    "resolution": "twice the resolution",
    "updates": "the scene built anew",
    "all": "without all four",
}
SHARP = 4  # times the samples of a picture, for its photograph
LONG_PATHS = {"type": "path", "max_depth": 8}


def picture(scene: Describe, params: Params, variant: str = VARIANT, **settings: Any) -> Picture:
    """The picture of a scene as a function of y, a black box.

    Each has a scene of its own, as meshes would be moved for all that share them. Settings are
    `resolution`, `spp`, `seed` and `integrator`, as for the renderer.
    """
    import mitsuba as mi

    from smoothdiff.renderers import mitsuba

    mi.set_variant(variant)  # transforms cannot be made before
    described = scene(mi.ScalarTransform4f())
    about = turning(params)
    render = mitsuba.renderer(described, list(params), axis=about, variant=variant, **settings)
    return lambda y, key=None: render({name: of(y) for name, of in params.items()}, key)


def dearer(
    scene: Describe, params: Params, resolution: int, spp: int, variant: str
) -> dict[str, Picture]:
    """The render as it is, under "", and without each saving by its name."""
    import mitsuba as mi

    def render(**changes: Any) -> Picture:
        usual = {"resolution": resolution, "spp": spp}
        return jax.jit(picture(scene, params, variant, **(usual | changes)))

    def anew(render: Picture) -> Picture:
        def built(y: Array) -> Array:
            # only what it costs matters: what is rendered is the scene that is there
            mi.load_dict(scene(mi.ScalarTransform4f()), optimize=False)
            return render(y)

        return built

    return {
        "": render(),
        "integrator": render(integrator=LONG_PATHS),
        "samples": render(spp=4 * spp),
        "resolution": render(resolution=2 * resolution),
        "updates": anew(render()),  # its own, or what is there would need no update
        "all": anew(render(resolution=2 * resolution, spp=4 * spp, integrator=LONG_PATHS)),
    }


def fidelities(
    scene: Describe, params: Params, variant: str, sought: Array, resolution: int, spp: int
) -> list[Level]:
    """Long paths, from few pixels and samples up to these, beside a photograph."""
    import mitsuba as mi

    from smoothdiff.renderers import mitsuba

    sharp = {"resolution": resolution, "spp": SHARP * spp, "integrator": LONG_PATHS}
    photo = np.asarray(picture(scene, params, variant, seed=1, **sharp)(sought))

    def made() -> list[Level]:
        return mitsuba.levels(
            scene(mi.ScalarTransform4f()),
            list(params),
            photo,
            spp=spp,
            integrator=LONG_PATHS,
            inputs=lambda y: {name: of(y) for name, of in params.items()},
            axis=turning(params),
            variant=variant,
        )

    # a scene of its own for each, as meshes would be moved for all that share them
    return [made()[i] for i in range(len(made()))]


def turning(params: Params) -> dict[str, Any]:
    """What each object that is named turns about."""
    return {name.rpartition(".")[0]: UP for name in params} | {"camera": None}


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


def mesh(name: str, positions: Positions, faces: Faces, bsdf: Description) -> Any:
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
