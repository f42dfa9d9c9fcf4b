"""What every test runs under: strict dtypes and ranks, warnings as errors, x64 off by default."""

import jax
import pytest

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")


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
