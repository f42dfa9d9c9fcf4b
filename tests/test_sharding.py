"""The samples of one estimate over several devices, here several of one host in a fresh process."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh, NamedSharding, PartitionSpec

import smoothdiff as sd
from tests.closed_forms import as_users_have_it

SCRIPT = """
import re, sys
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
import smoothdiff as sd

count = int(sys.argv[1])
assert jax.device_count() == count
mesh = jax.make_mesh((count,), ("samples",))
square = Mesh(np.array(jax.devices()).reshape(2, -1), ("rows", "samples"))
of_square = NamedSharding(square, PartitionSpec(("rows", "samples")))
key, x = jax.random.key(0), jnp.array([0.3, -0.4, 1.2])
image = lambda x: jnp.where(jnp.arange(53.0) < 20 * jnp.sum(x), 1.0, 0.0)
loss = lambda x: jnp.mean(image(x)) + jnp.sum(jnp.abs(x))

def same(transform, *args, **options):
    one = jax.jit(transform(**options))(*args)
    for sharding in (mesh, of_square):
        many = jax.jit(transform(sharding=sharding, **options))(*args)
        scale = max(float(jnp.max(jnp.abs(leaf))) for leaf in jax.tree.leaves(one))
        close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5 * scale)
        jax.tree.map(close, one, many)

few = {"num_samples": 64, "baseline": "mean"}
grad = lambda **options: sd.smooth_grad(loss, 0.2, **options)
same(grad, key, x, stderr=True, **few)
same(grad, key, x, batch_size=16, sampler=sd.Gaussian(), **few)
same(grad, key, x, num_samples=64, baseline="linear")
same(lambda **options: sd.smooth_hvp(loss, 0.2, **options), key, x, x, **few)
same(lambda **options: sd.smooth_jacobian(image, 0.2, **options), key, x, **few)

f = sd.smooth(image, 0.2, num_samples=64, baseline="none", sampler=sd.Gaussian(), sharding=mesh)
np.testing.assert_allclose(f(key, x), jax.jit(f)(key, x), rtol=1e-5)  # outside of jit
text = jax.jit(f).lower(key, x).compile().as_text()
shapes = {int(rows) for rows in re.findall(r"\\[(\\d+),53\\]", text)}
assert max(shapes) == 64 // count, shapes  # of all samples no device has more
assert len(re.findall(r" all-reduce(?:-start)?\\(", text)) == 1, text

# a solver: devices evaluate its points, and each keeps a part of the residuals of all
bend = lambda y, args: jnp.tile(y + jnp.sin(y) / 2 - jnp.arange(3.0), 16)[:40]
run = {"key": key, "max_evaluations": 8 * count}
with_devices = lambda s: sd.GaussNewton(0.1, num_samples=count, sharding=s)
one, many = (
    sd.least_squares(bend, x, solver=with_devices(s), **run) for s in (None, mesh)
)
assert one.evaluations == many.evaluations
np.testing.assert_allclose(many.fun, one.fun, atol=1e-6)
np.testing.assert_allclose(many.y, one.y, atol=1e-4)
rows = many.state.search.history.rows
assert {shard.data.shape for shard in rows.addressable_shards} == {(len(rows), 40 // count)}
"""


@pytest.mark.slow
@pytest.mark.parametrize("count", [4, 8])
def test_the_estimate_is_the_same_on_any_number_of_devices(count, devices):
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(count)],
        capture_output=True,
        text=True,
        env=devices(count),
    )
    assert done.returncode == 0, done.stderr


def test_one_device_is_a_mesh_too_and_without_one_there_is_no_equation(key):
    f = lambda x: jnp.sum(jnp.abs(x))
    options = {"num_samples": 16, "baseline": "mean"}
    mesh = Mesh(np.array(jax.devices()[:1]), ("samples",))
    x = jnp.ones(2)
    plain, over = (sd.smooth_grad(f, 0.3, sharding=s, **options) for s in (None, mesh))
    np.testing.assert_allclose(jax.jit(over)(key, x), plain(key, x), rtol=1e-6)
    assert "sharding_constraint" in str(jax.make_jaxpr(over)(key, x))
    assert "sharding_constraint" not in str(jax.make_jaxpr(plain)(key, x))


def test_what_cannot_be_shared_out_is_an_error(key):
    device = np.array(jax.devices()[:1])
    grad = lambda sharding: sd.smooth_grad(jnp.sum, 0.1, num_samples=12, sharding=sharding)
    square = Mesh(device.reshape(1, 1), ("a", "b"))
    with pytest.raises(ValueError, match=r"say along which .* PartitionSpec.'a'."):
        grad(square)
    for spec in (PartitionSpec(), PartitionSpec(None), PartitionSpec("a", "b")):
        with pytest.raises(ValueError, match="samples have one axis"):
            grad(NamedSharding(square, spec))
    with pytest.raises(TypeError, match=r"must be a mesh of devices, such as jax\.make_mesh"):
        as_users_have_it(sd.smooth_grad)(jnp.sum, 0.1, num_samples=12, sharding=jax.devices())
    grad(NamedSharding(square, PartitionSpec("b")))(key, jnp.ones(2))


def test_a_solver_with_devices_evaluates_all_at_once():
    mesh = Mesh(np.array(jax.devices()[:1]), ("samples",))
    with pytest.raises(ValueError, match="leave out batch_size"):
        sd.GaussNewton(0.1, sharding=mesh, batch_size=4)
    with pytest.raises(TypeError, match="must be a mesh of devices"):
        as_users_have_it(sd.GaussNewton)(0.1, sharding=jax.devices())


def test_devices_have_the_same_number_of_samples(monkeypatch):
    from smoothdiff import _sharding

    device = np.array(jax.devices()[:1])
    sharding = NamedSharding(Mesh(device, ("samples",)), PartitionSpec("samples"))
    monkeypatch.setattr(_sharding, "parts", lambda sharding: 8)
    with pytest.raises(ValueError, match=r"is 12, which 8 devices .* such as 16"):
        _sharding.check_parts(sharding, 12, "num_samples")
