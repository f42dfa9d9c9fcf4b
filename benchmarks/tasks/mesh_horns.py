"""A body with thin horns, begun from a sphere (Fig. 11 of the paper, and Fig. 12's filters).

The paper remeshes on the way; here the sphere is fine from the start.
"""

import numpy as np

from benchmarks.descents import Descent
from benchmarks.scenes.mesh_recovery import recovery
from benchmarks.scenes.mesh_renderer import views_around
from benchmarks.scenes.meshes import TIPS, distance_to_horned, horned, icosphere

TITLE = "Sphere to a body with thin horns"


def build(full: bool) -> Descent:
    number, size = (25, 128) if full else (10, 64)
    return recovery(
        "mesh-horns",
        TITLE,
        start=icosphere(5 if full else 4),
        target=horned(6),
        distance=distance_to_horned,
        points=np.concatenate([TIPS, horned(2)[0]]),
        views=views_around(number, size),
        rates=(0.03, 0.06, 0.12),
        marks=(50, 100, 200, 400) if full else (25, 50, 100, 200),
        levels=(0.01, 0.005),
        seeds=5 if full else 2,
    )
