"""The notebooks run from top to bottom, and are committed with their outputs."""

from pathlib import Path

import nbformat
import pasted
import pytest

NOTEBOOKS = sorted((Path(__file__).parent.parent / "notebooks").glob("*.ipynb"))


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path: Path, tmp_path, context):
    cells = [c for c in nbformat.read(path, as_version=4).cells if c.cell_type == "code"]
    assert any(cell.outputs for cell in cells), "commit the notebook with its outputs"
    # most of the time is compiling
    quick = {"jax_disable_most_optimizations": True, "jax_traceback_in_locations_limit": 0}
    process = context.Process(target=pasted.run_notebook, args=(path, tmp_path, quick))
    process.start()
    process.join(600)
    process.kill()
    printed, errors = ((tmp_path / name).read_text() for name in (pasted.OUT, pasted.ERRORS))
    assert process.exitcode == 0, f"{printed}\n{errors}"
