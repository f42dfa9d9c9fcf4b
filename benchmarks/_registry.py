"""What there is: tasks, methods and studies, found by looking into their packages.

To add one, write a file. A file of `tasks` has TASKS, name -> TaskEntry; a file of `methods` has
METHODS, name -> MethodEntry; a file of `studies` is a command, see `_study`. Names with a leading
underscore are parts of others.
"""

import importlib
import inspect
import pkgutil
import re
from functools import cache
from pathlib import Path
from types import ModuleType

from benchmarks import methods as methods_package
from benchmarks import studies as studies_package
from benchmarks import tasks as tasks_package
from benchmarks._names import is_ours
from benchmarks._task import Kind, Method, MethodEntry, Task, TaskEntry

ORDER: tuple[Kind, ...] = ("scene", "large", "network", "program", "function", "descent")
SCENES = ("scene", "large", "network")  # the kinds that `run all` runs and `report` shows


def _modules(package: ModuleType) -> list[ModuleType]:
    found = (name for _, name, _ in pkgutil.iter_modules(package.__path__) if name[0] != "_")
    return [importlib.import_module(f"{package.__name__}.{name}") for name in sorted(found)]


@cache
def tasks() -> dict[str, TaskEntry]:
    """All tasks, by kind and then by name."""
    modules = _modules(tasks_package)
    found = {name: entry for module in modules for name, entry in module.TASKS.items()}
    return dict(sorted(found.items(), key=lambda item: (ORDER.index(item[1].kind), item[0])))


def task(name: str) -> TaskEntry:
    """A task by its name."""
    return _named(tasks(), name, "task")


def told(entry: TaskEntry) -> list[str]:
    """What a task's module says of it, in paragraphs: what is varied, what is left out and why."""
    found = (module for module in _modules(tasks_package) if entry in module.TASKS.values())
    module = next(found, None) or inspect.getmodule(entry.build)
    text = (module.__doc__ if module else None) or ""
    return [" ".join(part.split()) for part in text.strip().split("\n\n")]


def family(name: str, full: bool) -> list[Task]:
    """The task of a name, or all that it stands for."""
    built = task(name).build(full)
    return built if isinstance(built, list) else [built]


def scenes() -> list[str]:
    """The tasks that `run all` runs."""
    return [name for name, entry in tasks().items() if entry.kind in SCENES]


@cache
def _entries() -> dict[str, tuple[ModuleType, MethodEntry]]:
    found = {
        name: (module, entry)
        for module in _modules(methods_package)
        for name, entry in module.METHODS.items()
    }
    # ours last: in tables and figures they are looked for there
    return dict(sorted(found.items(), key=lambda item: (is_ours(item[0]), item[0])))


def methods(kind: Kind | None = None) -> list[str]:
    """The names of all methods, ours last, or of those that run on a kind of task unasked."""
    return [name for name, (_, entry) in _entries().items() if kind is None or kind in entry.kinds]


def method(name: str) -> Method:
    """A method by its name."""
    module, entry = _named(_entries(), name, "method")
    return Method(name, entry.title, entry.prepare, _source(inspect.getsource(module)))


def grid(name: str) -> dict[str, tuple[float, ...]]:
    """Values for the settings of a method, among which its best are sought; see `_tune`."""
    _, entry = _named(_entries(), name, "method")
    return {setting: tuple(values) for setting, values in entry.grid.items()}


def studies() -> dict[str, ModuleType]:
    """The commands beside `run`, by name."""
    return {module.__name__.rpartition(".")[2]: module for module in _modules(studies_package)}


def _named(found: dict, name: str, what: str):
    if name not in found:
        raise SystemExit(f"There is no {what} {name!r}; choose from {', '.join(found)}.")
    return found[name]


def _source(text: str) -> str:
    """The text of a module, followed by the text of the modules here that it imports, in turn."""
    found = {"": text}
    waiting = [text]
    while waiting:
        for name in re.findall(r"from benchmarks\.methods(?:\.| import )(\w+)", waiting.pop()):
            path = Path(methods_package.__path__[0], f"{name}.py")
            if name not in found and path.exists():
                found[name] = path.read_text()
                waiting.append(found[name])
    return "".join(text for _, text in sorted(found.items()))
