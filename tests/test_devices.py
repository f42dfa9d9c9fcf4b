"""The function runs where JAX does, the steps of a search on a CPU; a second CPU plays the GPU."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import smoothdiff as sd
from smoothdiff import _devices
from tests.parts import quick_of

SCRIPT = """
import os, sys, tempfile
import jax, jax.numpy as jnp
import smoothdiff as sd
from smoothdiff import _host_problem

cpu, other = jax.devices()
plays = lambda device: "cpu" if device == cpu else "gpu"
current = lambda: jax.config.jax_default_device or other
jax.config.update("jax_default_device", other)
for name in "_devices", "_programs":
    sys.modules["smoothdiff." + name].default_platform = lambda: plays(current())
_host_problem.is_moved = lambda device: device != cpu

places, rows_at = set(), _host_problem.rows_at
def seen(*args):
    rows = rows_at(*args)
    places.update(rows.devices())
    return rows
_host_problem.rows_at = seen

there = lambda y: jax.device_put(y, other)
start = jnp.zeros(2)
far = there(jnp.array([1.0, -0.5]))  # committed: it cannot be moved
bowl = lambda y, args: jnp.sum((y - args) ** 2)
offsets = lambda y, args: y - args
noisy = lambda y, args, key: bowl(y, args) + jax.random.normal(key) / 1000
space, whole, box = sd.Range(-2, 2), sd.Integer(-3, 3), (-2.0, 2.0)
file = os.path.join(tempfile.mkdtemp(), "run")
few = {"checkpoint": file, "max_evaluations": 12}
for call, fun, y0, more in (
    (sd.minimise, bowl, start, {}),
    (sd.minimise, bowl, there(start), {"bounds": (there(start - 2), there(start + 2))}),
    (sd.minimise, bowl, start, {"space": space, "max_evaluations": 25}),
    (sd.minimise, bowl, start, {"solver": sd.NewtonCG(0.3, num_samples=3), "max_evaluations": 60}),
    (sd.minimise, noisy, start, {"takes_key": True, "max_evaluations": 60}),
    (sd.least_squares, offsets, start, {}),
    (sd.least_squares, offsets, start, few),
    (sd.least_squares, offsets, start, few | {"max_evaluations": 40}),
    (sd.least_squares, offsets, there(start), {"space": space, "key": there(jax.random.key(1))}),
    (sd.least_squares, offsets, start, {"space": whole, "args": there(jnp.array([1.0, 0.0]))}),
):
    options = {"key": jax.random.key(0), "args": far} | more
    result = call(fun, y0, **options)
    assert jnp.linalg.norm(result.y - options["args"]) < 0.1, result
    assert {d for leaf in jax.tree.leaves(result.state) for d in leaf.devices()} == {cpu}
    assert places == {other}, places
    assert (result.y + 1).devices() == {other}  # it goes wherever it is wanted
search = sd.Search(there(start), key=there(jax.random.key(0)))
for _ in range(20):
    points = search.ask(2)
    search.tell(points, [bowl(y, far) for y in points])
assert search.fun < 1e-3
assert search._state.search.history.points.devices() == {cpu}
places.clear()
result = sd.minimise(bowl, jax.device_put(start, cpu), 1.0, key=jax.random.key(0))
assert places == {cpu} and result.fun < 1e-6  # who chose it has it
"""


@pytest.mark.slow
def test_steps_are_on_the_cpu_and_the_function_is_where_jax_is(devices):
    ran = subprocess.run([sys.executable, "-c", SCRIPT], env=devices(2), capture_output=True)
    assert ran.returncode == 0, ran.stderr.decode()


@pytest.mark.parametrize("no_cpu", quick_of([False, True], [False]))
def test_steps_that_are_moved_are_the_same(monkeypatch, no_cpu):
    residuals = lambda y, args: jnp.append(jnp.sin(y) - 0.3, y[0] * y[1])

    def run():
        # also beside a GPU, whose roundings are others
        with jax.default_device(jax.devices("cpu")[0]):
            result = sd.least_squares(residuals, jnp.ones(2), key=jax.random.key(0))
        return np.array([(*r.y, r.fun) for r in result.history])

    before = run()
    monkeypatch.setattr(_devices, "platform_of", lambda device: "gpu")
    if no_cpu:  # as with JAX_PLATFORMS=cuda
        monkeypatch.setattr(_devices, "_cpu", lambda: None)
    assert _devices.is_moved(None) != no_cpu
    np.testing.assert_array_equal(run(), before)
