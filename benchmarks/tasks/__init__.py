"""The tasks. Each is a module with TITLE and `build(full) -> Task`, imported when it is asked for.

To add one, write the module and name it here.
"""

import importlib
from types import ModuleType

TASKS = {
    "shadow": "benchmarks.tasks.shadow",
}


def module(name: str) -> ModuleType:
    """The module of a task. What it imports at its top must be light."""
    if name not in TASKS:
        raise ValueError(f"There is no task {name!r}; choose from {', '.join(TASKS)}.")
    return importlib.import_module(TASKS[name])
