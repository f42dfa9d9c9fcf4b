"""All the runs of a descent, tuned and scored, each kept on disk as soon as it ends.

An interrupted benchmark goes on where it was. A file is named by the fingerprint of its run, so one
whose program or inputs have changed is run anew, and descents that have runs in common share them.
"""

import os
from collections.abc import Collection
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from tqdm import tqdm

from benchmarks.descents._descent import Configuration, Descent, Scene
from benchmarks.descents._loop import Loop, Run

TUNING_SEED = 1000  # the first of those that are not scored


class Choice(NamedTuple):
    """What the tuning settled on, and the error of everything that was tried."""

    variant: str
    rate: float
    tried: dict[str, dict[float, float]]


class Runs:
    """Gives runs: from disk where they are valid, else by running."""

    def __init__(self, descent: Descent, folder: Path, fresh: bool):
        self._descent, self._folder, self._fresh = descent, folder, fresh
        self._loops: dict[tuple[str, str], Loop] = {}
        self._scenes: dict[int, Scene] = {}

    def obtain(
        self,
        configuration: Configuration,
        variant: str,
        rate: float,
        seed: int,
        last: int,
        keep: Collection[int] = (),
    ) -> Run:
        """The run of a variant at a learning rate from the start of a seed to an iteration."""
        loop = self._loops.get((configuration.name, variant))
        if loop is None:
            loop = Loop(self._descent, configuration.variants[variant])
            self._loops[configuration.name, variant] = loop
        if seed not in self._scenes:
            self._scenes[seed] = self._descent.scene(seed)
        scene = self._scenes[seed]
        path = self._folder / f"{loop.fingerprint(rate, seed, scene, last)}.npz"
        structure = jax.tree.structure(self._descent.start(seed, scene))
        found = None if self._fresh else _load(path, keep, structure)
        if found is None:
            found = loop(rate, seed, scene, last, keep)
            _write(path, found)
        return found


def run_all(
    descent: Descent, seeds: int, folder: Path, *, fresh: bool, progress: bool
) -> dict[str, tuple[Choice, list[Run]]]:
    """Tunes each configuration and runs it from each start, by name.

    All configurations run from one start before the next, so that what else the machine does at
    the time falls on all of them.
    """
    runs = Runs(descent, folder, fresh)
    tuning = sum(len(each.variants) for each in descent.configurations)
    tuning *= len(descent.rates) * descent.tuning_seeds
    last = descent.marks[-1]
    keep = descent.pictured or (last,)
    found: dict[str, tuple[Choice, list[Run]]] = {}
    total = tuning + seeds * len(descent.configurations)
    with tqdm(total=total, disable=not progress, unit="run") as bar:
        for each in descent.configurations:
            bar.set_description(f"{descent.name}: tuning {each.name}")
            found[each.name] = _tune(runs, descent, each, bar), []
        for seed in range(seeds):
            for each in descent.configurations:
                bar.set_description(f"{descent.name}: start {seed}, {each.name}")
                choice, scored = found[each.name]
                kept = () if seed else keep  # pictures show the first start
                scored.append(runs.obtain(each, *choice[:2], seed, last, kept))
                bar.update()
    return found


def _tune(runs: Runs, descent: Descent, configuration: Configuration, bar: tqdm) -> Choice:
    """The variant and the rate with the lowest error, the geometric mean over the seeds."""
    last = configuration.tuned_at or descent.marks[-1]

    def error(variant: str, rate: float) -> float:
        errors = []
        for seed in range(TUNING_SEED, TUNING_SEED + descent.tuning_seeds):
            run = runs.obtain(configuration, variant, rate, seed, last)
            errors.append(run.errors[descent.score][-1])
            bar.update()
        return float(np.exp(np.mean(np.log(errors))))

    tried = {
        variant: {rate: error(variant, rate) for rate in descent.rates}
        for variant in configuration.variants
    }
    variant = min(tried, key=lambda name: min(tried[name].values()))
    rate = min(tried[variant], key=lambda rate: tried[variant][rate])
    return Choice(variant, rate, tried)


def _load(path: Path, keep: Collection[int], structure) -> Run | None:
    if not path.exists():
        return None
    with np.load(path) as stored:
        content = dict(stored)
    kept = {
        mark: jax.tree.unflatten(
            structure, [content[f"kept {mark} {i}"] for i in range(structure.num_leaves)]
        )
        for mark in keep
        if f"kept {mark} 0" in content
    }
    if len(kept) < len(keep):  # it was run without
        return None
    errors = {k.removeprefix("error "): v for k, v in content.items() if k.startswith("error ")}
    return Run(content["iterations"], content["seconds"], errors, kept)


def _write(path: Path, run: Run) -> None:
    """Writes all or nothing, so that a kill leaves no half file."""
    content: dict[str, Any] = {"iterations": run.iterations, "seconds": run.seconds}
    content |= {f"error {name}": values for name, values in run.errors.items()}
    for mark, y in run.kept.items():
        content |= {f"kept {mark} {i}": leaf for i, leaf in enumerate(jax.tree.leaves(y))}
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    with open(temporary, "wb") as file:
        np.savez_compressed(file, **content)
    os.replace(temporary, path)
