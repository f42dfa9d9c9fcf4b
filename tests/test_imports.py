"""What `import smoothdiff` brings in, in a fresh interpreter."""

import json
import os
import subprocess
import sys

import pytest

# the neighbours first, so that what comes after them is smoothdiff's own
SCRIPT = """
import json, sys
import jax, optax, optimistix
before = set(sys.modules)
import smoothdiff
print(json.dumps([sorted(before), sorted(sys.modules)]))
"""
ALONE = "import json, sys, smoothdiff; print(json.dumps(sorted(sys.modules)))"
DRAWN = """
import json, sys, jax, smoothdiff
smoothdiff.Sobol().draw(jax.random.key(0), 0, 4, 4, 2, jax.numpy.float32)
print(json.dumps(sorted(sys.modules)))
"""
HEAVY = ("mitsuba", "drjit", "matplotlib", "dask", "distributed", "cma", "IPython", "scipy.stats")


def fresh(script):
    done = subprocess.run(
        [sys.executable, "-W", "ignore:jaxlib", "-c", script],
        capture_output=True,
        text=True,
        env=os.environ,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""  # no warnings either
    return json.loads(done.stdout)


@pytest.mark.parametrize("script", [ALONE, DRAWN], ids=["imported", "drawn"])
def test_nothing_heavy_or_optional_is_loaded(script):
    """By the import, or for points of Sobol's sequence."""
    loaded = fresh(script)
    assert "smoothdiff" in loaded
    assert [name for name in HEAVY if name in loaded] == []


def test_import_brings_little_but_its_own():
    before, after = map(set, fresh(SCRIPT))
    # an import costs what it loads: beside the standard library nothing is new but tqdm, which is
    # small, and perhaps a part of JAX
    assert "smoothdiff" not in before
    cheap = sys.stdlib_module_names | {"smoothdiff", "tqdm", "jax", "jaxlib"}
    assert [name for name in sorted(after - before) if name.partition(".")[0] not in cheap] == []
