"""Meshes to be fitted by a black box: smooth coordinates, and which pixels to blame.

The coordinates are those of Large Steps in Inverse Rendering of Geometry (Nicolet et al. 2021).
What vertices have, their positions or their colours, is

    x = x₀ + c (I + λL)⁻¹ y,

so that a step or a perturbation of y bends a surface and does not crumple it. The number c is such
that noise of size 1 in y moves vertices by about 1.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import smoothdiff as sd
from benchmarks.scenes.mesh_renderer import Views, edges_of
from benchmarks.scenes.meshes import Faces
from smoothdiff.filters._triangles import vertex_normals

LAM = 19.0
TILE = 2  # pixels, along each side of what is one term of the loss
REACH = 0.15  # how far a perturbation is seen around a vertex
BEHIND = 0.3  # the cosine of normals and the view, from where on a vertex is never seen


class Soft:
    """Values at vertices, (vertices, channels), as a function of y, which is 0 for `rest`."""

    def __init__(self, rest: np.ndarray, faces: Faces, gain: float = 1.0):
        self._rest, self._faces = np.asarray(rest, np.float32), faces
        self._smooth = sd.filters.mesh_laplacian(faces, LAM)
        noise = self._smooth(jax.random.normal(jax.random.key(0), rest.shape), None)
        self._gain = gain / float(jnp.std(noise))

    def __call__(self, y: Float[Array, "vertices channels"]) -> Float[Array, "vertices channels"]:
        """The values."""
        return jnp.asarray(self._rest) + self._gain * self._smooth(y, None)

    def coordinates(self, values: np.ndarray) -> np.ndarray:
        """The y of given values."""
        moved = (values - self._rest) / self._gain
        i, j = edges_of(self._faces).ends.T
        found, flow = moved.copy(), LAM * (moved[i] - moved[j])
        np.add.at(found, i, flow)
        np.add.at(found, j, -flow)
        return found.astype(np.float32)


def support(soft: Soft, faces: Faces, views: Views) -> Callable[[Any], Array]:
    """Which tiles of the views a vertex may change: those near to where it is seen.

    Smoothed perturbations only fade with the distance, so this is an approximation: about two
    fifths of what a vertex changes are there.
    """
    tiles = views.size // TILE
    half = views.extent / tiles
    middles = jnp.asarray(half * (2 * np.arange(tiles) + 1) - views.extent, jnp.float32)
    frames = jnp.asarray(views.frames, jnp.float32)

    def around(y: dict[str, Array]) -> Callable[[dict[str, Array]], Array]:
        positions = soft(y["positions"])
        right, down, _ = jnp.einsum("vin,kn->ivk", frames, positions)
        facing = jnp.einsum("vn,kn->vk", frames[:, 2], vertex_normals(positions, faces)) < BEHIND
        across, along = (
            jnp.maximum(jnp.abs(at[:, None] - middles[None, :, None]) - half, 0)
            for at in (right, down)
        )
        near = along[:, :, None] ** 2 + across[:, None] ** 2 < REACH**2
        matrix = (near & facing[:, None, None]).astype(positions.dtype)

        def blame(y: dict[str, Array]) -> Float[Array, "views tiles tiles"]:
            return matrix @ sum(jnp.sum(field, axis=1) for field in y.values())

        return blame

    return sd.moving_support(around)
