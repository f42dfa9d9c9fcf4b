"""Where numbers come from: the machine, the versions of packages, and the state of the code."""

import os
import platform
import subprocess
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

PACKAGES = (
    *("smoothdiff", "jax", "jaxlib", "optax", "optimistix", "equinox", "lineax", "numpy", "scipy"),
    *("mitsuba", "coco-experiment", "cma", "evosax", "jaxopt", "Py-BOBYQA", "DFO-LS", "pygad"),
    "sif2jax",
)
SHOWN = ("jax", "mitsuba")  # versions in one line: those that seconds depend on


def machine() -> dict[str, Any]:
    """What stands at the head of results."""
    versions = {of.name: of.version for of in metadata.distributions() if of.name in PACKAGES}
    return {
        "platform": platform.platform(),
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "versions": versions,
    }


def in_one_line(machine: dict[str, Any]) -> str:
    """A machine as the page names it; seconds are compared where these are the same."""
    known = [package for package in SHOWN if package in machine["versions"]]
    packages = ", ".join(f"{package} {machine['versions'][package]}" for package in known)
    system = f" ({machine['platform']})" if "platform" in machine else ""
    python = machine["python"]
    return f"{machine['cores']} cores of {machine['cpu']}{system}, Python {python}, {packages}"


@cache
def here() -> str:
    """This machine in one line; it stands in each run, as what is kept may be of several."""
    return in_one_line(machine())


@cache
def commit() -> str:
    """The last commit that changed smoothdiff, with a plus where that was changed since."""
    try:
        changed = _git("status", "--porcelain", "smoothdiff")
        return _git("log", "-1", "--format=%h", "--", "smoothdiff") + "+" * bool(changed)
    except (OSError, subprocess.CalledProcessError):
        return ""


def _git(*words: str) -> str:
    root = Path(__file__).parent.parent
    asked = subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=True)
    return asked.stdout.strip()


def _cpu() -> str:
    try:
        with open("/proc/cpuinfo") as lines:
            return next(line.split(":")[1].strip() for line in lines if "model name" in line)
    except (OSError, StopIteration):
        return platform.processor()
