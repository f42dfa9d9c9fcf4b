"""What `import smoothdiff` costs, in a fresh interpreter."""

import json
import os
import subprocess
import sys

# one process: the neighbours first, so that what remains is smoothdiff's own
SCRIPT = """
import json, sys, time
import jax, optax, optimistix
before = set(sys.modules)
start = time.process_time()
import smoothdiff
seconds = time.process_time() - start
print(json.dumps({"seconds": seconds, "before": sorted(before), "after": sorted(sys.modules)}))
"""
ALONE = "import json, sys, smoothdiff; print(json.dumps(sorted(sys.modules)))"
HEAVY = ("mitsuba", "drjit", "matplotlib", "dask", "distributed", "cma", "IPython", "scipy.stats")


def fresh(script, **environment):
    done = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        env=os.environ | environment,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""  # no warnings either
    return json.loads(done.stdout)


def test_import_brings_nothing_heavy_or_optional():
    loaded = fresh(ALONE)
    assert "smoothdiff" in loaded
    assert [name for name in HEAVY if name in loaded] == []


def test_import_adds_less_than_a_fifth_of_a_second(tmp_path):
    # bytecode is kept between the runs, as pip keeps it for whoever installs the package; another
    # process on the same core only ever adds time, so that the least of them is the import's own
    kept = {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": str(tmp_path)}
    runs = [fresh(SCRIPT, **kept) for _ in range(4)]
    assert "smoothdiff" not in runs[0]["before"]
    assert min(run["seconds"] for run in runs) < 0.2
