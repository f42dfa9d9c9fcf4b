"""From a scene of Mitsuba to a task: what all of these scenes have in common.

A scene's module says what is in the picture, what is varied, what is sought and where to start. The
picture is rendered by `scalar_rgb` with the same noise at every call: it is the same on every
machine, and at so few pixels it is as fast as any other variant. The photograph that is to be
matched has many samples and other noise. Mitsuba is imported when a task is built.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from benchmarks._task import Budget, NativeAD, Task
from benchmarks.scenes._dearer import dearer

VARIANT = "scalar_rgb"
EXACT, PHOTO = 9, 64  # times the samples, for the score and for the photograph
UP = (0, 0, 1)  # what objects turn about that turn

Description = dict[str, Any]  # for mitsuba.load_dict
# for a scene with one lamp that is a point: no noise, and no edges of shadows that AD could see
DIRECT = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}
DIRECT_AD = {"type": "direct_projective", "sppi": 0}
NO_AD: Description = {}


def scene_task(
    full: bool,
    *,
    name: str,
    title: str,
    scene: Callable[[Any], Description],
    params: Mapping[str, Callable[[Array], Array]],
    reference: Sequence[float],
    bounds: tuple[Sequence[float], Sequence[float]],
    start_box: tuple[Sequence[float], Sequence[float]],
    sigma: float,
    budget: Budget,
    resolution: int = 32,
    spp: int = 4,
    ad_integrator: Description = NO_AD,
) -> Task:
    """The task of finding the parameters of a scene from a picture of it.

    Args:
        full: 20 starts, not 5.
        name: The task's name.
        title: What is sought, in one line.
        scene: Describes the scene, given an identity transform to make others from.
        params: By name, as for `smoothdiff.renderers.mitsuba.renderer`: its value, of y.
        reference: The y that is sought.
        bounds: (low, high), each like y.
        start_box: (low, high): starts are uniform in between.
        sigma: The scale of all entries of y.
        budget: Where a run ends.
        resolution: Pixels along a side.
        spp: Samples per pixel, a square.
        ad_integrator: What Mitsuba differentiates the picture with, or NO_AD where it cannot.

    Returns:
        The task. Its loss is the mean squared difference of the pictures.
    """
    import mitsuba as mi

    from smoothdiff.renderers import mitsuba

    mi.set_variant(VARIANT)  # transforms cannot be made before
    described = scene(mi.ScalarTransform4f())

    settings: Any = {"axis": UP, "resolution": resolution, "variant": VARIANT}

    def renderer(spp: int, seed: int = 0) -> Callable[[Array], Array]:
        render = mitsuba.renderer(described, list(params), spp=spp, seed=seed, **settings)
        return lambda y: render({key: value(y) for key, value in params.items()})

    sought = jnp.asarray(reference, jnp.float32)
    render, image, again = renderer(spp), renderer(EXACT * spp), renderer(EXACT * spp, seed=2)
    photo = np.asarray(renderer(PHOTO * spp, seed=1)(sought))
    exact, exact_again = image(sought), again(sought)

    def exact_loss(y: Array) -> Array:
        # other noise in each factor: in the mean it vanishes, where squares would add it up
        product = (image(y) - exact) * (again(y) - exact_again)
        return jnp.maximum(jnp.mean(product), 0)

    def start(seed: int) -> Float[Array, " n"]:
        low, high = (jnp.asarray(end, jnp.float32) for end in start_box)
        return jax.random.uniform(jax.random.key(seed), sought.shape, minval=low, maxval=high)

    def native_ad() -> NativeAD:
        from benchmarks.scenes import _mitsuba_ad

        return _mitsuba_ad.value_and_grad(scene, params, ad_integrator, photo, spp)

    return Task(
        name=name,
        title=title,
        loss=lambda y: jnp.mean((render(y) - photo) ** 2),
        exact_loss=exact_loss,
        start=start,
        reference=sought,
        bounds=(jnp.asarray(bounds[0], jnp.float32), jnp.asarray(bounds[1], jnp.float32)),
        sigma=sigma,
        budget=budget,
        seeds=20 if full else 5,
        image=image,
        residuals=lambda y: render(y) - photo,
        native_ad=native_ad if ad_integrator else None,
        dearer=lambda: dearer(scene, params, spp=spp, **settings),
        notes=f"{resolution} x {resolution} pixels, {spp} samples per pixel, {VARIANT}",
    )


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
