"""The tasks. Each is a module with TITLE and `build(full)`, imported when it is asked for.

`build` gives a Task, or a list of them where one name stands for a family, such as a function in
several dimensions; they are named "function-5d". Problems that come with gradients are Descents
instead, one or several. To add one, write the module and name it here.
"""

import importlib
from types import ModuleType

BLACK_BOXES = {
    "shadow": "benchmarks.tasks.shadow",
    "quad": "benchmarks.tasks.quad",
    "box2": "benchmarks.tasks.box2",
    "box10": "benchmarks.tasks.box10",
    "box10-occluding": "benchmarks.tasks.box10_occluding",
    "rocket": "benchmarks.tasks.rocket",
    "brdf": "benchmarks.tasks.brdf",
    "rosenbrock": "benchmarks.tasks.rosenbrock",
    "negated-gaussian": "benchmarks.tasks.negated_gaussian",
    "ellipsoid": "benchmarks.tasks.ellipsoid",
    "bbob": "benchmarks.tasks.bbob",
}
# programs with switches, counts and rotations, and the weights of networks, as in ZeroGrads
PROGRAMS = {
    "led": "benchmarks.tasks.led",
    "mosaic": "benchmarks.tasks.mosaic",
    "rocket10": "benchmarks.tasks.rocket10",
    "gravity": "benchmarks.tasks.gravity",
    "wicker": "benchmarks.tasks.wicker",
    "node-graph": "benchmarks.tasks.node_graph",
    "texture256": "benchmarks.tasks.texture256",
    "mlp": "benchmarks.tasks.mlp",
    "spline-vae": "benchmarks.tasks.spline_vae",
}
# scenes of Mitsuba with few parameters
SCENES = {
    "shadow": BLACK_BOXES["shadow"],
    "brdf": BLACK_BOXES["brdf"],
    "mug": "benchmarks.scenes.mug",
    "bunny": "benchmarks.scenes.bunny",
    "cornell-box": "benchmarks.scenes.cornell_box",
    "glass-ball": "benchmarks.scenes.glass_ball",
    "mirror": "benchmarks.scenes.mirror",
    "occlusion": "benchmarks.scenes.occlusion",
    "global-illumination": "benchmarks.scenes.global_illumination",
    "sort": "benchmarks.scenes.sort",
}
# scenes with many parameters, and networks in front of a renderer
LARGE = {
    "texture32": "benchmarks.tasks.texture32",
    "caustic": "benchmarks.tasks.caustic",
    "suzanne": "benchmarks.tasks.suzanne",
    "banana": "benchmarks.tasks.banana",
    "cnn": "benchmarks.tasks.cnn",
    "cnn5": "benchmarks.tasks.cnn5",
}
DESCENTS = {
    "aniso": "benchmarks.tasks.aniso",
    "noisy": "benchmarks.tasks.noisy",
    "texture": "benchmarks.tasks.texture",
    "volume": "benchmarks.tasks.volume",
    "mesh-cube": "benchmarks.tasks.mesh_cube",
    "mesh-horns": "benchmarks.tasks.mesh_horns",
}
ALL_SCENES = SCENES | LARGE  # what `run all` runs and `report` shows
TASKS = BLACK_BOXES | PROGRAMS | SCENES | LARGE | DESCENTS


def module(name: str) -> ModuleType:
    """The module of a task. What it imports at its top must be light."""
    if name not in TASKS:
        raise ValueError(f"There is no task {name!r}; choose from {', '.join(TASKS)}.")
    return importlib.import_module(TASKS[name])
