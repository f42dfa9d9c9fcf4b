"""The report of ZeroGrads: what the paper shows of its method, on the programs that are here.

`toy` is its Fig. 4, `ablations` its Table 2 and the supplement's Fig. 2, `gradients` its Fig. 11
with what that leaves open, and `samples` the supplement's Fig. 3. `replay` and `control_variate`
are of what is ours.

Source: ZeroGrads: Learning Local Surrogates for Non-Differentiable Graphics (Fischer and Ritschel).
"""

import json
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks._summary import machine
from benchmarks.zerograds import ablations, control_variate, gradients, replay, samples, toy
from benchmarks.zerograds._setting import FULL, QUICK, Setting

__all__ = ["FULL", "PARTS", "QUICK", "Setting", "main"]

PARTS = {
    "toy": toy,
    "ablations": ablations,
    "gradients": gradients,
    "samples": samples,
    "replay": replay,
    "control_variate": control_variate,
}


def main(folder: Path, setting: Setting, *, command: str, fresh: bool = False) -> None:
    """Measures what has not been measured, prints tables, writes results.json and pictures."""
    results: dict[str, Any] = {
        "command": command,
        "setting": setting.name,
        "machine": machine(),
    }
    results |= {name: part.measure(setting, folder, fresh) for name, part in PARTS.items()}
    folder.mkdir(parents=True, exist_ok=True)
    # numbers become texts as keys: what is shown is what is written
    text = json.dumps(_rounded(results))
    (folder / "results.json").write_text(text + "\n")
    results = json.loads(text)
    console = Console()
    for name, part in PARTS.items():
        part.draw(results[name], folder)
        console.print(part.tables(results[name]))
    console.print(f"Written to {folder}")


def _rounded(tree: Any) -> Any:
    """Numbers with the digits that they deserve."""
    if isinstance(tree, float):
        return float(f"{tree:.4g}")
    if isinstance(tree, dict):
        return {key: _rounded(value) for key, value in tree.items()}
    return [_rounded(value) for value in tree] if isinstance(tree, list | tuple) else tree
