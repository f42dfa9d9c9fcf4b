"""Results of scenes that were never run, for tests of what is said of them."""

import numpy as np
from stripes import REFERENCE, TITLE, build

from benchmarks._summary import of_runs
from benchmarks._task import TaskEntry, Traits
from benchmarks.studies.report._scene import Scene

MACHINE = {"cpu": "a <CPU>", "cores": 2, "python": "3.11", "versions": {"jax": "1"}}
ABOUT = {"setting": "quick", "command": "python -m benchmarks run all", "machine": MACHINE}


def run_of(seed, factor, evaluations, machine="a <CPU>"):
    """A run whose errors fall by `factor` a step of so many evaluations, which take 0.1 s each."""
    errors = factor ** -np.arange(6.0)
    return {
        "seed": seed,
        "machine": machine,
        "evaluations": evaluations * np.arange(6),
        "seconds": 0.1 * evaluations * np.arange(6),
        "image_error": errors,
        "parameter_error": errors,
        "distance": errors[-1],
        "found": np.asarray(REFERENCE),
        "warm_up_seconds": 1.0,
    }


def of_scene(found, dimensions=2):
    """The results of a scene: method -> evaluations of a step, of each start, or a reason."""

    def of_method(took):
        if isinstance(took, str):
            return {"not_able": took}
        each = took if isinstance(took, tuple) else (took, took)
        return of_runs([run_of(seed, 10, step) for seed, step in enumerate(each)])

    return {
        "title": TITLE,
        "notes": "few <pixels>",
        "budget": {"evaluations": 60, "seconds": 60},
        "sigma": 0.3,
        "dimensions": dimensions,
        "methods": {
            name: {"title": name.title()} | of_method(took) for name, took in found.items()
        },
    }


def scene(name="shadow", dimensions=2, plateaus=True, **found):
    """A scene; a step of so many evaluations takes a tenth of the error that is left."""
    entry = TaskEntry(TITLE, "scene", build, Traits((dimensions,), plateaus))
    return Scene(name, of_scene(found, dimensions), ABOUT, entry, name)


def never(scene, method, *costs):
    """The scene, where no start of the method gets to a level."""
    for level in scene.ran[method]["took"]["image_error"].values():
        level["solved"] = 0
        for cost in costs or ("evaluations", "seconds"):
            level[cost] |= dict.fromkeys(("median", "lower", "upper", "least", "most"))
    return scene
