"""Code as its reader runs it: in a file of its own, by a process that has imports alone. No tests.

Imports are a third of the time of most examples, so the processes are forked from one that has
made them, and has not started JAX.
"""

import os
import runpy
import sys
from pathlib import Path

import jax
import matplotlib.pyplot  # noqa: F401
import optax  # noqa: F401

import smoothdiff  # noqa: F401

CODE, OUT, ERRORS = "pasted.py", "printed.txt", "errors.txt"


def run(folder: Path, config: dict[str, bool | int]) -> None:
    """Runs what was pasted into the folder, with these settings of JAX."""
    os.chdir(folder)
    for stream, name in ((sys.stdout, OUT), (sys.stderr, ERRORS)):
        os.dup2(os.open(name, os.O_CREAT | os.O_WRONLY), stream.fileno())
    for name, value in config.items():
        jax.config.update(name, value)
    try:
        runpy.run_path(CODE, run_name="__main__")
    finally:
        sys.stdout.flush()
