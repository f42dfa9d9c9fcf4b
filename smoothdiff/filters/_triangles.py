"""What filters on a mesh need to know of its triangles: edges, normals, cotangents."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from smoothdiff._params import is_concrete

SLIVER = 1e-6  # twice the least area that a triangle is taken to have, in units of longest side²


def as_faces(faces: Any) -> np.ndarray:
    """Those with three different vertices, as integers; ValueError where they are no faces."""
    if not is_concrete(faces):
        raise ValueError(
            "faces must be known when the filter is made: make it outside of jit, and name faces "
            "and lam in static_args of optax.inject_hyperparams"
        )
    faces = np.asarray(faces)
    if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
        raise ValueError(
            f"faces must have the shape (faces, 3), a row of three vertices for each triangle, not "
            f"{faces.shape}; cut other polygons into triangles"
        )
    if not np.issubdtype(faces.dtype, np.integer):
        raise ValueError(
            f"faces must be integers, the indices of vertices, not {faces.dtype}; write "
            "faces.astype(int) if that is what they are"
        )
    if faces.min() < 0:
        raise ValueError(f"faces must count vertices from 0, but has the index {faces.min()}")
    faces = faces.astype(np.int32)
    different = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    if not different.any():
        raise ValueError("faces has no triangle with three different vertices")
    return faces[different]


def edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The ends (2, edges) of each edge once, and (faces, 3) which edge faces each corner."""
    n = np.int64(faces.max()) + 1  # its square may be too large for 32 bits
    low, high = np.sort(np.stack([np.roll(faces, -1, axis=1), np.roll(faces, 1, axis=1)]), axis=0)
    found, facing = np.unique((low * n + high).ravel(), return_inverse=True)
    ends = np.stack(np.divmod(found, n)).astype(np.int32)
    return ends, facing.reshape(faces.shape).astype(np.int32)


def cotangents(positions: Array, faces: np.ndarray) -> Array:
    """(faces, 3): the cotangent of the angle at each corner."""
    sides = _sides(positions, faces)
    cosines = -jnp.sum(jnp.roll(sides, -1, axis=1) * jnp.roll(sides, 1, axis=1), axis=2)
    longest = jnp.max(jnp.sum(sides**2, axis=2), axis=1)
    area = jnp.maximum(_length(jnp.cross(sides[:, 0], sides[:, 1])), SLIVER * longest)
    # one area for the three of a triangle: whatever it is, the matrix stays positive
    return cosines / jnp.where(area > 0, area, 1)[:, None]


def vertex_normals(positions: Array, faces: np.ndarray) -> Array:
    """Unit normals, the faces at a vertex weighted by their area; zero where they have none."""
    sides = _sides(positions, faces)
    of_faces = jnp.cross(sides[:, 0], sides[:, 1])
    total = jnp.zeros_like(positions).at[faces].add(of_faces[:, None])
    length = _length(total)
    return total / jnp.where(length > 0, length, 1)[:, None]


def _sides(positions: Array, faces: np.ndarray) -> Array:
    """(faces, 3, 3): the side that faces each corner, in units of the largest coordinate."""
    corners = positions[faces]
    sides = jnp.roll(corners, -1, axis=1) - jnp.roll(corners, 1, axis=1)
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(sides)))  # what is made of them has no scale
    return sides / jnp.where(largest > 0, largest, 1)


def _length(vectors: Array) -> Array:
    """Of each row, with a derivative of zero at zero, and without underflow of the squares."""
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(vectors), axis=-1))
    scale = jnp.where(largest > 0, largest, 1)
    square = jnp.sum((vectors / scale[..., None]) ** 2, axis=-1)
    return jnp.where(largest > 0, scale * jnp.sqrt(jnp.where(largest > 0, square, 1)), 0)
