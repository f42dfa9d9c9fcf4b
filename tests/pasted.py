"""Code as its reader runs it, by a process that has imports alone. No tests here.

Imports are a third of the time of most examples, so the processes are forked from one that has
made them, and has not started JAX.
"""

import os
import runpy
import sys
from pathlib import Path

import jax
import matplotlib.pyplot  # noqa: F401
import nbformat
import optax  # noqa: F401
from IPython.core.interactiveshell import InteractiveShell
from IPython.core.pylabtools import activate_matplotlib
from matplotlib_inline.backend_inline import configure_inline_support
from traitlets.config import Config

import smoothdiff  # noqa: F401

CODE, OUT, ERRORS = "pasted.py", "printed.txt", "errors.txt"
INLINE = "module://matplotlib_inline.backend_inline"


def begin(folder: Path, config: dict[str, bool | int]) -> None:
    """What is printed is in the folder, and JAX has these settings."""
    for stream, name in ((sys.stdout, OUT), (sys.stderr, ERRORS)):
        os.dup2(os.open(folder / name, os.O_CREAT | os.O_WRONLY), stream.fileno())
    for name, value in config.items():
        jax.config.update(name, value)


def run(folder: Path, config: dict[str, bool | int]) -> None:
    """Runs what was pasted into a file in the folder."""
    os.chdir(folder)
    begin(folder, config)
    try:
        runpy.run_path(CODE, run_name="__main__")
    finally:
        sys.stdout.flush()


def run_notebook(path: Path, folder: Path, config: dict[str, bool | int]) -> None:
    """Runs the cells of a notebook as Jupyter does, with its magic and its pictures."""
    os.chdir(path.parent)
    begin(folder, config)
    shell = InteractiveShell.instance(config=Config({"HistoryManager": {"enabled": False}}))
    activate_matplotlib(INLINE)
    configure_inline_support(shell, INLINE)
    cells = [cell for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
    for number, cell in enumerate(cells, 1):
        ran = shell.run_cell(cell.source, store_history=True)
        sys.stdout.flush()
        if not ran.success:
            sys.exit(f"{path.name} fails in code cell {number}:\n{cell.source}")
