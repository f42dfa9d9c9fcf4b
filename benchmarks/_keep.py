"""What was run here takes its place among the committed results, method by method.

So a method that changed is measured again without the others. Each says on which machine it ran, as
seconds are compared on one machine only. What somebody remarked on the old numbers goes.
"""

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import _atlas, _registry
from benchmarks._machine import in_one_line
from benchmarks._study import committed, write
from benchmarks._summary import able

SAME = ("budget", "sigma", "dimensions", "notes")  # what methods that stand side by side share


def keep(name: str, runs: Path, results: Path) -> dict[str, Any]:
    """Writes the committed results of a task anew, with what was run, and gives them."""
    new, old = committed(name, runs), committed(name, results)
    if new is None:
        raise SystemExit(f"{name} was not run here: python -m benchmarks run {name}")
    return write(new if old is None else merged(old, new), results / name)


def merged(old: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    """The old results, with the methods of the new ones in place of theirs and beside them."""
    for task in old["tasks"].values():
        for found in able(task).values():
            found.setdefault("machines", [in_one_line(old["machine"])])
    tasks = {
        name: _task(old["tasks"][name], task) if name in old["tasks"] else task
        for name, task in new["tasks"].items()
    }
    commands = dict.fromkeys([*old["command"].split("; "), new["command"]])
    return new | {"command": "; ".join(commands), "tasks": old["tasks"] | tasks}


def _task(old: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    if differ := [what for what in SAME if old[what] != new[what]]:
        raise SystemExit(
            f"{new['title']}: another {' and '.join(differ)} than in what is committed"
        )
    # what is not able here, for want of a package say, replaces nothing
    methods = _in_order(new["methods"] | old["methods"] | able(new))
    task = new | {"methods": methods}
    of_old, of_new = (_atlas.stored(of, list(able(of))) for of in (old, new))
    if of_old is not None and of_new is not None:
        found = of_old.found | of_new.found
        line = [of_new.start, *(found[name] for name in able(task)), of_new.reference]
        task["pictures"] = _atlas.png(np.concatenate(line))
    else:
        task["pictures"] = None
    films = [film for of in (old, new) if (film := of.get("film"))]
    if films:
        task["film"] = _film(films)
    return task


def _film(films: list[dict[str, Any]]) -> dict[str, Any]:
    frames, errors = {}, {}
    for film in films:
        frames |= _atlas.frames(film)
        errors |= film["errors"]
    frames = _in_order(frames)
    line = [frame for each in frames.values() for frame in each]
    shown = {
        "errors": {name: errors[name] for name in frames},
        "png": _atlas.png(np.concatenate(line)),
    }
    return films[-1] | shown


def _in_order(found: dict[str, Any]) -> dict[str, Any]:
    """By the order of methods; those that are no more come first."""
    known = _registry.methods()
    place = lambda name: known.index(name) if name in known else -1
    return {name: found[name] for name in sorted(found, key=place)}
