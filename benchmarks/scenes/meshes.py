"""Triangle meshes made by formulas: spheres, cubes, and a body with thin horns.

A mesh is an array of positions (vertices, 3) and one of faces (faces, 3), counter-clockwise seen
from outside. What is sought also comes as a signed distance, so that how far a vertex is from its
surface is known without a mesh.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import ConvexHull

Positions = Float[np.ndarray, "vertices 3"]
Faces = Int[np.ndarray, "faces 3"]

SIDE = 0.75  # half of the cube's
BODY = 0.65  # radius of the body that has horns
ROOT, TIP = 0.2, 0.04  # radii of a horn in the middle of the body and at its end
HORNS = np.array([[0.65, 1.15, 0.25], [-0.65, 1.15, 0.25], [0.0, -0.2, 1.3], [0.3, -1.1, -0.65]])

TIPS = HORNS * (1 + TIP / np.linalg.norm(HORNS, axis=1, keepdims=True))


def icosphere(level: int) -> tuple[Positions, Faces]:
    """A unit sphere of 10 * 4^level + 2 vertices: an icosahedron, each face cut into four."""
    golden = (1 + 5**0.5) / 2
    signs = np.array([[0, 1, 1], [0, -1, 1], [0, 1, -1], [0, -1, -1]]) * [0, 1, golden]
    positions = np.concatenate([np.roll(signs, shift, axis=1) for shift in range(3)])
    faces = _outwards(positions, ConvexHull(positions).simplices)
    for _ in range(level):
        positions, faces = _cut_into_four(positions, faces)
    return positions / np.linalg.norm(positions, axis=1, keepdims=True), faces


def ball(vertices: int) -> tuple[Positions, Faces]:
    """A unit sphere of any number of vertices."""
    positions, _ = spiral(vertices)
    return positions, _outwards(positions, ConvexHull(positions).simplices)


def spiral(number: int) -> tuple[Positions, Float[np.ndarray, " vertices"]]:
    """Directions that are spread evenly over the sphere (a Fibonacci lattice); their longitudes."""
    k = np.arange(number) + 0.5
    z, angle = 1 - 2 * k / number, np.pi * (1 + 5**0.5) * k
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1), angle


def cube(cells: int) -> tuple[Positions, Faces]:
    """A cube from -SIDE to SIDE, each of its faces cut into cells² squares of two triangles."""
    i, j = np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij")
    corners = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
    flat = np.stack([np.stack(c, axis=-1) for c in corners], axis=2).reshape(-1, 4, 2)
    sides = [
        np.roll(np.insert(flat, 0, level, axis=2), shift, axis=2)
        for shift in range(3)
        for level in (0, cells)
    ]
    lattice, places = np.unique(np.concatenate(sides).reshape(-1, 3), axis=0, return_inverse=True)
    squares = places.reshape(-1, 4)
    positions = SIDE * (2 * lattice / cells - 1)
    return positions, _outwards(positions, squares[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3))


def horned(level: int) -> tuple[Positions, Faces]:
    """A ball with thin horns: an icosphere whose vertices lie where their rays leave the body."""
    directions, faces = icosphere(level)
    inside, outside = np.zeros((len(directions), 1)), np.full((len(directions), 1), 2.0)
    for _ in range(30):
        middle = (inside + outside) / 2
        within = np.asarray(distance_to_horned(jnp.asarray(middle * directions)))[:, None] < 0
        inside, outside = np.where(within, middle, inside), np.where(within, outside, middle)
    return inside * directions, faces


def distance_to_cube(points: Float[Array, "points 3"]) -> Float[Array, " points"]:
    """The distance to the surface of `cube`, negative inside."""
    beyond = jnp.abs(points) - SIDE
    outside = jnp.linalg.norm(jnp.maximum(beyond, 0), axis=1)
    return outside + jnp.minimum(jnp.max(beyond, axis=1), 0)


def distance_to_horned(points: Float[Array, "points 3"]) -> Float[Array, " points"]:
    """The distance to the surface of `horned`, negative inside, where it is a lower bound."""
    distances = [jnp.linalg.norm(points, axis=1) - BODY]
    for end in HORNS:
        length = float(np.linalg.norm(end))
        along = points @ jnp.asarray(end / length, points.dtype)
        across = jnp.sqrt(jnp.maximum(jnp.sum(points**2, axis=1) - along**2, 0))
        # a cone that touches a ball at either end; its half angle has the sine:
        sine = (ROOT - TIP) / length
        cosine: float = (1 - sine**2) ** 0.5
        where = cosine * along - sine * across
        cone = cosine * across + sine * along - ROOT
        tip = jnp.hypot(across, along - length) - TIP
        root = jnp.hypot(across, along) - ROOT
        distances.append(jnp.where(where < 0, root, jnp.where(where > cosine * length, tip, cone)))
    return jnp.min(jnp.stack(distances), axis=0)


def _outwards(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The faces of a convex body around the origin, counter-clockwise seen from outside."""
    corners = positions[faces]
    clockwise = np.linalg.det(corners) < 0
    return np.where(clockwise[:, None], faces[:, ::-1], faces)


def sides_of(faces: Faces) -> Int[np.ndarray, "sides 2"]:
    """The vertices at the three sides of each face, one after the other."""
    return np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)


def _cut_into_four(positions: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The middle of each side becomes a vertex."""
    ends, middles = np.unique(np.sort(sides_of(faces), axis=1), axis=0, return_inverse=True)
    a, b, c = faces.T
    ab, bc, ca = middles.reshape(-1, 3).T + len(positions)
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    cut = np.concatenate([np.stack(part, axis=1) for part in parts])
    return np.concatenate([positions, positions[ends].mean(axis=1)]), cut
