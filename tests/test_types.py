"""Shapes and types of all arguments are as they are written down, where some tests go."""

import subprocess
import sys

import pytest
from pages import ROOT

# with the checks, a test takes a fifth more time, so these run with them and all others without
CHECKED = ("transforms", "search", "residual_trust", "large_steps")


@pytest.mark.slow
def test_shapes_and_types_are_what_they_say():
    files = [ROOT / "tests" / f"test_{name}.py" for name in CHECKED]
    hook = "--jaxtyping-packages=smoothdiff,beartype.beartype"
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", hook, *files]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout
