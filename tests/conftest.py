"""What every test runs under: strict dtypes and ranks, warnings as errors, x64 off by default."""

import collections
import concurrent.futures
import gc
import math
import multiprocessing
import multiprocessing.forkserver
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

# a small solve that waits for threads of LAPACK on busy cores takes a hundred times as long
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import pytest

from smoothdiff._jaxlib import take_threads

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")


# Programs that are the same in several tests are compiled once: the second time, they come from a
# folder of this run alone, or from one that is given. Processes that tests start have it as well.
CACHE = {"min_compile_time_secs": "0", "min_entry_size_bytes": "-1"}

# XLA's older, smaller code for fused operations, in one piece, as optimised as any: half the time
# to compile. Tests of a plain install go without.
FLAGS = "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
# modules of what optimisations may change, rounding above all: the slow part compiles them as for
# users. Statistics, closed forms and studies hold whatever XLA does.
OPTIMISED = [
    "extreme",
    "fuzz",
    "fuzz_runs",
    "gauss_newton",
    "minimise",
    "numerics",
    "precision",
    "residual_trust",
    "returned_point",
    "scalar_fit",
    "tasks",
    "transforms",
]


# what is compiled is kept for later modules, unless the process has so many bytes before one, or
# so many more than the last time that it was dropped: what was freed stays with the process
MEMORY, MORE = 3e9, 2e8


class Process:
    """How this process compiled for its last module, and how many bytes it may have."""

    quickly: bool | None = None
    limit = MEMORY


def pytest_configure(config):
    """The quick part compiles with few optimisations, `pytest -m slow` some modules with all.

    Most of a test is compiling, which takes less than half as long.
    """
    gc.set_threshold(100_000, 50, 50)  # looking for garbage is a twentieth of the time
    quick = config.option.markexpr != "slow"
    jax.config.update("jax_disable_most_optimizations", quick)
    if quick:  # a tenth of the time goes into the lines of code that XLA's programs would name
        jax.config.update("jax_traceback_in_locations_limit", 0)
    if not hasattr(config, "workerinput"):  # workers inherit what the first process has set
        folder = os.environ.get("JAX_COMPILATION_CACHE_DIR")
        if folder is None:
            folder = tempfile.mkdtemp()
            config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))
        for name, value in CACHE.items():
            os.environ[f"JAX_PERSISTENT_CACHE_{name.upper()}"] = value
        os.environ["JAX_COMPILATION_CACHE_DIR"] = folder
        take_threads()
        if "XLA_FLAGS" not in os.environ and knows(FLAGS):
            os.environ["XLA_FLAGS"] = FLAGS
    # of tests in the first process, which has imported JAX before
    jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
    for name, value in CACHE.items():
        jax.config.update(f"jax_persistent_cache_{name}", int(value))


@pytest.fixture(scope="session")
def quickly_compiled():
    """The environment of a process of its own that compiles as the quick part does."""
    return {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1", "JAX_TRACEBACK_IN_LOCATIONS_LIMIT": "0"}


@pytest.fixture(scope="session")
def devices(quickly_compiled):
    """Makes the environment of a process that compiles so, and has so many devices."""

    def of(count):
        flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={count}"
        return {**os.environ, **quickly_compiled, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}

    return of


@pytest.fixture(scope="session")
def context():
    """Processes that have imported everything, and have not started JAX."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["killed_runs", "pasted"])
    # until Python 3.13 the server does not know where this process looks for modules
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))
        multiprocessing.forkserver.ensure_running()
    return context


@pytest.fixture(scope="session")
def as_users():
    """The environment of a process of its own that compiles as users' do."""
    return {k: v for k, v in os.environ.items() if (k, v) != ("XLA_FLAGS", FLAGS)}


def knows(flags):
    """Whether this jaxlib has the flags: XLA ends a process that gives it others."""
    start = [sys.executable, "-c", "import jax; jax.devices()"]
    tried = subprocess.run(start, env={**os.environ, "XLA_FLAGS": flags}, capture_output=True)
    return tried.returncode == 0


def compiles_quickly(config, module):
    """Whether the tests of a module do."""
    return config.option.markexpr != "slow" or module.rpartition("test_")[2] not in OPTIMISED


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config, items):
    """Modules that compile alike follow each other, those of many tests first."""
    tests = collections.Counter(item.path for item in items)
    first = lambda item: (compiles_quickly(config, item.path.stem), -tests[item.path], item.path)
    items.sort(key=first)


@pytest.fixture(autouse=True, scope="module")
def forget_compiled(request):
    """Drops what was compiled where it is too much, or of no use to a module."""
    quickly = compiles_quickly(request.config, request.module.__name__)
    if Process.quickly not in (quickly, None) or memory() > Process.limit:
        jax.clear_caches()
        if math.isfinite(memory()):
            Process.limit = max(Process.limit, memory() + MORE)
    Process.quickly = quickly
    jax.config.update("jax_disable_most_optimizations", quickly)


def memory():
    """How many bytes this process has, as if too many where the system does not say."""
    pages = Path("/proc/self/statm")
    if not pages.exists():
        return math.inf
    return int(pages.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.fixture
def x64():
    """Switches float64 on for one test and off again after it."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(params=["float32", pytest.param("float64", marks=pytest.mark.slow)])
def dtype(request):
    """Runs a test in both precisions; float64 is slow and switched on only for its own run.

    It compiles quickly, as float32 does in the quick part: it is the same test.
    """
    double, quickly = request.param == "float64", Process.quickly
    jax.config.update("jax_disable_most_optimizations", quickly or double)
    with jax.enable_x64(double):
        yield jax.numpy.dtype(request.param)
    jax.config.update("jax_disable_most_optimizations", quickly)


@pytest.fixture
def key():
    """A typed key with a fixed seed."""
    return jax.random.key(0)


@pytest.fixture
def threads():
    """Two threads to call a black box on."""
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        yield pool


@pytest.fixture
def listens_to_ctrl_c():
    """A shell that starts the tests in the background tells them to ignore Ctrl-C."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
