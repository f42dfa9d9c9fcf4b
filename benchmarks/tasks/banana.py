"""Banana: an ellipsoid of 2,737 vertices becomes a banana, its colours too.

After the Banana of higher-order differentiable rendering (section 4.1). The rasteriser has hard
edges, and no derivative of it is used.
"""

import numpy as np

from benchmarks._task import Budget, Task
from benchmarks.scenes import meshes, soft_mesh

TITLE = "Banana: 16,422 coordinates and colours of a mesh"
METHODS = (
    *("spsa", "fr22", "first_order", "zerograds"),
    *("local_gradient", "local_first_order", "gauss_newton", "local_gauss_newton"),
)
VERTICES = 2737
REST = (0.4, 0.4, 0.85)  # half axes of the ellipsoid
GREY = 0.5
COLOUR_GAIN = 5.0  # a colour of 0.15 is like a distance of 0.03
BEND = 0.55
YELLOW, GREEN, BROWN = (0.95, 0.8, 0.1), (0.35, 0.65, 0.15), (0.3, 0.18, 0.08)


def build(full: bool) -> Task:
    """y are smooth coordinates of the positions and of the colours, linear RGB."""
    directions, faces = soft_mesh.ball(VERTICES)
    rest = directions * REST
    positions = soft_mesh.Soft(rest, faces)
    colours = soft_mesh.Soft(np.full(rest.shape, GREY), faces, COLOUR_GAIN)
    return soft_mesh.mesh_task(
        full,
        "banana",
        TITLE,
        rest,
        faces,
        {"positions": (positions, bent(directions)), "albedo": (colours, painted(directions))},
        Budget(40_000, 1200) if full else Budget(16_000, 300),
    )


def bent(directions: meshes.Positions) -> meshes.Positions:
    """A long body with three blunt edges, bent, thin at its ends."""
    x, y, z = directions.T
    edges = 1 + 0.08 * np.cos(3 * np.arctan2(y, x))
    return np.stack([0.27 * edges * x + BEND * (z**2 - 0.4), 0.27 * edges * y, z], axis=1)


def painted(directions: meshes.Positions) -> np.ndarray:
    """Yellow, green towards one end, with brown ends and spots."""
    x, y, z = directions.T
    share = np.clip((z - 0.3) / 0.5, 0, 1)[:, None]
    colour = (1 - share) * np.array(YELLOW) + share * np.array(GREEN)
    spots = np.sin(4 * x + 2) * np.sin(5 * y + 1) * np.sin(5 * z)
    brown = np.clip(4 * np.maximum(spots - 0.3, np.abs(z) - 0.8), 0, 1)[:, None]
    return (1 - brown) * colour + brown * np.array(BROWN)
