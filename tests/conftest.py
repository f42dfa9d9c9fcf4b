"""What every test runs under: strict dtypes and ranks, warnings as errors, x64 off by default."""

import os
import subprocess
import sys

# a small solve that waits for threads of LAPACK on busy cores takes a hundred times as long
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import pytest

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")


# XLA's older, smaller code for fused operations, in one piece: half the time to compile
QUICK_FLAGS = "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"


def pytest_configure(config):
    """The quick part compiles with few optimisations; `pytest -m slow` runs what users run.

    Most of a quick test is compiling, which takes less than half as long.
    """
    quick = config.option.markexpr != "slow"
    jax.config.update("jax_disable_most_optimizations", quick)
    first = not hasattr(config, "workerinput")  # workers inherit what the first process has set
    if quick and first and "XLA_FLAGS" not in os.environ and knows(QUICK_FLAGS):
        os.environ["XLA_FLAGS"] = QUICK_FLAGS


def knows(flags):
    """Whether this jaxlib has the flags: XLA ends a process that gives it others."""
    start = [sys.executable, "-c", "import jax; jax.devices()"]
    tried = subprocess.run(start, env={**os.environ, "XLA_FLAGS": flags}, capture_output=True)
    return tried.returncode == 0


@pytest.fixture(autouse=True, scope="module")
def forget_compiled():
    """Drops what a module has compiled: kept, it adds up to gigabytes."""
    yield
    jax.clear_caches()


@pytest.fixture
def x64():
    """Switches float64 on for one test and off again after it."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(params=["float32", "float64"])
def dtype(request):
    """Runs a test in both precisions; float64 is switched on only for its own run."""
    with jax.enable_x64(request.param == "float64"):
        yield jax.numpy.dtype(request.param)


@pytest.fixture
def key():
    """A typed key with a fixed seed."""
    return jax.random.key(0)
