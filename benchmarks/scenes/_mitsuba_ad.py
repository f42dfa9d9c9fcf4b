"""The gradient of a scene's loss by Mitsuba's own automatic differentiation.

Mitsuba differentiates with respect to what it calls parameters: poses, positions of vertices,
colours. How these follow from y are exact little formulas, which are differenced.
"""

import zlib
from typing import Any

import drjit as dr
import jax.numpy as jnp
import mitsuba as mi
import numpy as np
from jaxtyping import Array, Float

from benchmarks._task import NativeAD, NotAble
from benchmarks.scenes.mitsuba_scene import UP, Describe, Description, Params
from smoothdiff.renderers import mitsuba
from smoothdiff.renderers._mitsuba_scene import Scene, mitsuba_with, scene_values

VARIANT = "llvm_ad_rgb"
STEP = 1e-2  # of the differences


def value_and_grad(
    scene: Describe,
    params: Params,
    integrator: Description,
    photo: Float[np.ndarray, "height width 3"],
    spp: int,
) -> NativeAD:
    """`y -> (loss, gradient)`, not to be traced by JAX; each y has other noise.

    The integrator is one that knows of edges that move, such as `direct_projective`.
    """
    if not mitsuba.available(VARIANT):
        raise NotAble(f"needs libllvm >= 17, for Mitsuba's variant {VARIANT}")
    height, width, _ = photo.shape
    with mitsuba_with(VARIANT):
        description = scene(mi.ScalarTransform4f())
        description["integrator"] = integrator
        # the border is for edges that enter the picture
        film = {"width": width, "height": height, "sample_border": True}
        description["camera"]["film"] |= film
        description["camera"].pop("sampler", None)  # the integrator needs one of its own
        loaded = Scene.of(description)
        parameters = mi.traverse(loaded.scene)
    axes = {key.removesuffix(".rotate"): UP for key in params if key.endswith(".rotate")}

    def of_scene(y: np.ndarray) -> dict[str, np.ndarray]:
        values = {key: np.asarray(value(jnp.asarray(y))) for key, value in params.items()}
        return scene_values(loaded, values, axes)

    def slope(y: np.ndarray, step: np.ndarray, gradients: dict[str, np.ndarray]) -> float:
        up, down = of_scene(y + step), of_scene(y - step)
        moves = {key: (up[key] - down[key]) / (2 * STEP) for key in gradients}
        return sum(float(np.vdot(moves[key], gradients[key])) for key in gradients)

    def evaluate(y: Float[Array, " n"]) -> tuple[Float[Array, ""], Float[Array, " n"]]:
        point = np.asarray(y)
        steps = STEP * np.eye(point.size, dtype=point.dtype)
        with mitsuba_with(VARIANT):
            leaves = {key: _leaf(parameters, key, x) for key, x in of_scene(point).items()}
            parameters.update()
            seed: Any = zlib.crc32(point.tobytes())
            image = mi.render(loaded.scene, parameters, spp=spp, seed=seed)
            loss = dr.mean(dr.square(image - mi.TensorXf(photo)), axis=None)
            dr.backward(loss)
            gradients = {key: np.array(dr.grad(leaf)) for key, leaf in leaves.items()}
            gradient = [slope(point, step, gradients) for step in steps]
            return jnp.asarray(loss.numpy()), jnp.asarray(gradient, y.dtype)

    return evaluate


def _leaf(parameters: Any, key: str, value: np.ndarray) -> Any:
    """Sets a parameter of the scene, and gives that which has a derivative."""
    kind = type(parameters[key])
    is_pose = hasattr(kind, "matrix")
    leaf = mi.Matrix4f(value) if is_pose else kind(value.astype(np.float32).ravel())
    dr.make_opaque(leaf)  # or Mitsuba compiles the numbers of a pose into its kernel
    dr.enable_grad(leaf)
    parameters[key] = kind(leaf) if is_pose else leaf
    return leaf
