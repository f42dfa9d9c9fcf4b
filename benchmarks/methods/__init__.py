"""The methods. Each is a module with TITLE and `prepare(task) -> solve`, imported when asked for.

To add one, write the module and name it here; the order is that of tables and figures. A method has
one setting for all tasks: it takes its scale from `task.sigma`, and from nothing else.
"""

import importlib
import inspect
from pathlib import Path

from benchmarks._task import Method

METHODS = {
    "finite_differences": "benchmarks.methods.finite_differences",
    "fr22": "benchmarks.methods.fr22",
    "cma_es": "benchmarks.methods.cma_es",
    "mitsuba_ad": "benchmarks.methods.mitsuba_ad",
}


def load(name: str) -> Method:
    """A method by its name."""
    if name not in METHODS:
        raise ValueError(f"There is no method {name!r}; choose from {', '.join(METHODS)}.")
    module = importlib.import_module(METHODS[name])
    shared = sorted(Path(__file__).parent.glob("_*.py"))
    source = inspect.getsource(module) + "".join(path.read_text() for path in shared)
    return Method(name, module.TITLE, module.prepare, source)
