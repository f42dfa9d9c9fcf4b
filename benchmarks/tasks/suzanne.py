"""Suzanne: a sphere of 2,562 vertices becomes a head with ears, by pictures from several sides.

After the mesh of higher-order differentiable rendering (section 4.1) and that of ZeroGrads
(supplement 2.2). The rasteriser has hard edges, and no derivative of it is used.
"""

import numpy as np

from benchmarks._task import Budget, Task
from benchmarks.scenes import meshes, soft_mesh

TITLE = "Suzanne: 7,686 coordinates of a mesh"
METHODS = (
    *("spsa", "fr22", "first_order", "zerograds"),
    *("local_gradient", "local_first_order", "gauss_newton", "local_gauss_newton"),
)
REST = 0.8  # radius of the sphere
SKULL = 0.75
# where bumps of the skull are, how high, and how wide as an angle
BUMPS = (
    ((1, 0.15, 0.1), 0.45, 0.28),  # ears
    ((-1, 0.15, 0.1), 0.45, 0.28),
    ((0, -0.55, 1), 0.3, 0.4),  # muzzle
    ((0.38, 0.35, 1), 0.16, 0.22),  # brows
    ((-0.38, 0.35, 1), 0.16, 0.22),
    ((0.35, 0.05, 1), -0.15, 0.15),  # eyes
    ((-0.35, 0.05, 1), -0.15, 0.15),
    ((0, 1, -0.2), 0.12, 0.5),  # top
)


def build(full: bool) -> Task:
    """y are smooth coordinates of the vertices."""
    directions, faces = meshes.icosphere(4)
    positions = soft_mesh.Soft(REST * directions, faces)
    return soft_mesh.mesh_task(
        full,
        "suzanne",
        TITLE,
        REST * directions,
        faces,
        {"positions": (positions, head(directions))},
        Budget(40_000, 1200) if full else Budget(8000, 300),
    )


def head(directions: meshes.Positions) -> meshes.Positions:
    """Where the rays from the middle leave the head."""
    radius = np.full(len(directions), SKULL)
    for place, height, width in BUMPS:
        cosine = directions @ np.array(place) / np.linalg.norm(place)
        radius += height * np.exp(-0.5 * (np.arccos(np.clip(cosine, -1, 1)) / width) ** 2)
    return radius[:, None] * directions
