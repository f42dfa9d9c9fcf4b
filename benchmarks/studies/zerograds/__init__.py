"""The report of ZeroGrads: what the paper shows of its method, on the programs that are here.

`toy` is its Fig. 4, `ablations` its Table 2 and the supplement's Fig. 2, `gradients` its Fig. 11
with what that leaves open, and `samples` the supplement's Fig. 3. `replay` and `control_variate`
are of what is ours. Parts are run by their names, or all; `--methods` are rows of `ablations`.

Source: ZeroGrads: Learning Local Surrogates for Non-Differentiable Graphics (Fischer and Ritschel).
"""

from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks._grid import Grid
from benchmarks.studies.zerograds import ablations, control_variate, gradients, replay, samples, toy

HELP = "the tables and figures of the ZeroGrads paper"
OPTIONS = ("names", "seeds", "fresh", "methods")
SEEDS = 2  # starts, unless it is said how many
MODULES = (toy, ablations, gradients, samples, replay, control_variate)
PARTS = {module.__name__.rpartition(".")[2]: module for module in MODULES}


def measure(options: Namespace, folder: Path) -> dict[str, Any]:
    """What each part measures from so many starts; runs are kept in the folder."""
    unknown = set(options.names) - set(PARTS)
    if unknown:
        raise SystemExit(f"There is no part {sorted(unknown)}; choose from {', '.join(PARTS)}.")
    starts, kept, fresh = options.seeds or SEEDS, folder / "runs", options.fresh
    rows = {"ablations": {"only": options.methods.split(",")}} if options.methods else {}
    return {
        name: {"starts": starts} | part.measure(starts, kept, fresh, **rows.get(name, {}))
        for name, part in PARTS.items()
        if name in (options.names or PARTS)
    }


def draw(results: dict[str, Any], folder: Path) -> None:
    """A picture of each part."""
    for name in PARTS:
        if name in results:
            PARTS[name].draw(results[name], folder / f"{name}.png")


def tables(results: dict[str, Any]) -> Iterator[Grid]:
    """The tables of each part."""
    for name in PARTS:
        if name in results:
            yield from PARTS[name].tables(results[name])
