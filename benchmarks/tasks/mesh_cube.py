"""A cube from ten views, begun from a sphere (Fig. 10 of the paper, and Fig. 12's filters)."""

from benchmarks.descents import Descent
from benchmarks.scenes.mesh_recovery import recovery
from benchmarks.scenes.mesh_renderer import views_around
from benchmarks.scenes.meshes import cube, distance_to_cube, icosphere

TITLE = "Sphere to cube from ten views"


def build(full: bool) -> Descent:
    return recovery(
        "mesh-cube",
        TITLE,
        start=icosphere(5 if full else 4),
        target=cube(48),
        distance=distance_to_cube,
        points=cube(6)[0],
        views=views_around(10, 128 if full else 64),
        rates=(0.01, 0.03, 0.06, 0.12) if full else (0.03, 0.06, 0.12),
        marks=(50, 100, 200, 400) if full else (15, 30, 60, 120),
        levels=(0.01, 0.005, 0.002),
        seeds=5 if full else 2,
    )
