"""Meshes fitted to pictures by a black box: smooth coordinates, and which pixels to blame.

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
from scipy.spatial import ConvexHull

import smoothdiff as sd
from benchmarks._task import Budget, Task
from benchmarks.scenes.mesh_renderer import Views, look, views_around
from benchmarks.scenes.meshes import Faces, Positions
from smoothdiff.filters._triangles import vertex_normals

LAM = 19.0
SIGMA, BOUND = 0.03, 0.3
EXTENT = 1.25  # what a view shows, from its middle
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
        sides = np.stack([self._faces, np.roll(self._faces, -1, axis=1)], axis=2).reshape(-1, 2)
        i, j = np.unique(np.sort(sides, axis=1), axis=0).T
        found, flow = moved.copy(), LAM * (moved[i] - moved[j])
        np.add.at(found, i, flow)
        np.add.at(found, j, -flow)
        return found.astype(np.float32)


def mesh_task(
    full: bool,
    name: str,
    title: str,
    rest: Positions,
    faces: Faces,
    fields: dict[str, tuple[Soft, np.ndarray]],
    budget: Budget,
) -> Task:
    """The task of fitting what vertices have to pictures of the mesh.

    Quick: 6 views of 24 x 24 pixels; full: the 13 of ZeroGrads, of 32 x 32.

    Args:
        full: As for all tasks.
        name: Of the task.
        title: What is sought.
        rest: Positions of the vertices from which a run starts.
        faces: Their triangles.
        fields: "positions", and "albedo" where it is sought too: each as a function of its y, and
            what is sought.
        budget: Where a run ends.
    """
    number, size = (13, 32) if full else (6, 24)
    views = views_around(number, size)._replace(extent=EXTENT)
    soft = {field: of for field, (of, _) in fields.items()}
    reference = {field: jnp.asarray(of.coordinates(x)) for field, (of, x) in fields.items()}

    def pictures(y: dict[str, Array]) -> Float[Array, "views size size 3"]:
        return look(faces=faces, views=views, **{field: soft[field](y[field]) for field in y})

    target = jax.jit(pictures)(reference)

    def residuals(y: dict[str, Array]) -> Float[Array, "views tiles tiles rest"]:
        """The pixels of a tile together."""
        tiles = size // TILE
        found = (pictures(y) - target).reshape(number, tiles, TILE, tiles, TILE, 3)
        return jnp.moveaxis(found, 3, 2).reshape(number, tiles, tiles, -1)

    def terms(y: dict[str, Array]) -> Float[Array, "views tiles tiles"]:
        return jnp.sum(residuals(y) ** 2, axis=-1) / target.size

    def start(seed: int) -> dict[str, Array]:
        noise = SIGMA / 3 * jax.random.normal(jax.random.key(seed), (len(rest), 3))
        return dict.fromkeys(reference, noise)

    ends = jax.tree.map(lambda y: jnp.full_like(y, BOUND), reference)
    return Task(
        name=name,
        title=title,
        loss=lambda y: jnp.sum(terms(y)),
        exact_loss=lambda y: jnp.sum(terms(y)),
        start=start,
        reference=reference,
        bounds=(jax.tree.map(jnp.negative, ends), ends),
        sigma=SIGMA,
        budget=budget,
        seeds=5 if full else 1,
        image=lambda y: jnp.concatenate(list(pictures(y)[:4]), axis=1),
        residuals=residuals,
        terms=terms,
        support=support(soft["positions"], faces, views),
        notes=f"{number} views of {size} x {size} pixels. Vertices may slide along the "
        "surface: the parameter error says nothing.",
    )


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


def ball(vertices: int) -> tuple[Positions, Faces]:
    """A unit sphere of any number of vertices, on a spiral."""
    k = np.arange(vertices) + 0.5
    z, angle = 1 - 2 * k / vertices, np.pi * (1 + 5**0.5) * k
    radius = np.sqrt(1 - z**2)
    positions = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    faces = ConvexHull(positions).simplices
    clockwise = np.linalg.det(positions[faces]) < 0
    return positions, np.where(clockwise[:, None], faces[:, ::-1], faces)
