"""Other versions of JAX than the one installed, each in an environment of its own."""

import shutil
import subprocess
import sys
from pathlib import Path

import jax
import pytest

ROOT = Path(__file__).parent.parent
# The newest wants a newer Python, if there is one. Warnings are errors, but for deprecations, which
# other packages meet, and what is said of versions that can hang
VERSIONS = ("0.9", "0.10", "newest")
QUIET = ["-W", "error", "-W", "ignore::DeprecationWarning", "-W", "ignore:jaxlib:RuntimeWarning"]

SCRIPT = """
from concurrent.futures import ThreadPoolExecutor
import jax, jax.numpy as jnp, numpy as np, optax
import smoothdiff as sd

key, x = jax.random.key(0), jnp.array([0.3, -0.4])
loss = lambda x: jnp.sum(jnp.floor(8 * jnp.abs(x)))
for baseline in ("auto", "linear", "quadratic"):
    value, grad = sd.smooth_value_and_grad(loss, 0.3, baseline=baseline)(key, x)
    assert np.isfinite(value) and np.all(np.isfinite(grad))
assert sd.smooth_hessian(loss, 0.3)(key, x).shape == (2, 2)
assert sd.smooth_hvp(loss, 0.3, batch_size=16, sampler=sd.Gaussian())(key, x, x).shape == (2,)
model = jax.jit(sd.smooth_quadratic(loss, 0.3))(key, x)
model.hessian.mv(model.grad)
outputs = lambda x: {"a": jnp.abs(x), "b": jnp.floor(x), "c": jnp.sum(x)}
many = sd.smooth_jacobian(outputs, 0.3, baseline="linear", sampler=sd.Orthogonal())
jax.block_until_ready(jax.jit(jax.vmap(many, (None, 0)))(key, jnp.ones((2000, 8))))

target = jnp.array([1.0, -0.5])
for solver in (None, sd.FirstOrder(optax.adam(0.1), 0.2), sd.ZeroGrads(0.3)):
    bowl = lambda y, args: jnp.sum((y - target) ** 2)
    result = sd.minimise(bowl, jnp.zeros(2), key=key, solver=solver, max_evaluations=400)
    assert result.fun < 0.1, (solver, result.fun)
residuals = lambda y, args: jnp.append(y - target, jnp.sum(y))
assert sd.least_squares(residuals, jnp.zeros(2), key=key, max_evaluations=100).fun < 0.1
with ThreadPoolExecutor(2) as pool:
    box = sd.black_box(lambda y: np.floor(4 * np.abs(y)).sum(), 0.0, executor=pool)
    result = sd.minimise(lambda y, _: box(y), jnp.ones(2), key=key, max_evaluations=60)
    assert result.fun == 0.0
print(jax.__version__)
"""


@pytest.mark.slow
@pytest.mark.parametrize("version", VERSIONS)
def test_transforms_and_solvers_run_with_other_versions_of_jax(
    version, tmp_path, as_users, quickly_compiled
):
    if jax.__version__.startswith(f"{version}."):
        pytest.skip("is installed, and has all other tests")
    python = newer_python() if version == "newest" else sys.executable
    subprocess.run([python, "-m", "venv", "--without-pip", tmp_path / "venv"], check=True)
    python = tmp_path / "venv" / "bin" / "python"
    wanted = "jax" if version == "newest" else f"jax=={version}.*"
    # the pip of these tests, and no file compiled that may not be imported: half of the time
    pip = [sys.executable, "-m", "pip", "--python", python]
    install = [*pip, "install", "--quiet", "--no-compile", wanted, ROOT]
    installed = subprocess.run(install, capture_output=True, text=True)
    if installed.returncode != 0:
        pytest.skip(f"cannot be installed here: {installed.stderr[-300:]}")
    environment = {**as_users, **quickly_compiled}
    environment.pop("NPROC", None)  # no user has more threads than cores
    run = {"env": environment, "capture_output": True, "text": True, "timeout": 500}
    done = subprocess.run([python, *QUIET, "-c", SCRIPT], cwd=tmp_path, **run)
    assert done.returncode == 0, done.stderr
    if version != "newest":
        assert done.stdout.startswith(f"{version}.")


def newer_python():
    """One that has a newer JAX than Python 3.11; beside this one, as pyenv and uv put them."""
    beside = map(str, Path(sys.base_prefix).parent.glob("*/bin/python3.1[2-9]"))
    named = filter(None, (shutil.which(f"python3.{minor}") for minor in range(12, 20)))
    for python in [*sorted(beside), *named]:
        if subprocess.run([python, "-c", "import venv"], capture_output=True).returncode == 0:
            return python
    pytest.skip("there is no Python newer than 3.11")
