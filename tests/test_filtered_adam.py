"""Transformations: Adam without filters, Algorithm 2 by hand, bounded steps, optax's wrappers."""

import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from smoothdiff import (
    FirstOrder,
    filter_updates,
    filtered_adam,
    minimise,
    scale_by_filtered_adam,
)
from smoothdiff.filters import cross_bilateral, laplacian

SMOOTH = cross_bilateral(0.5, 2, ndim=2)


def random(*shape, dtype=jnp.float32, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), dtype)


def steps(optimiser, params, count=3):
    """Updates for random gradients, with the parameters moving."""
    state, found = optimiser.init(params), []
    update = jax.jit(optimiser.update)
    for i in range(count):
        grads = jax.tree.map(lambda p, i=i: random(*p.shape, dtype=p.dtype, seed=i + 1), params)
        with jax.numpy_dtype_promotion("standard"):  # optax mixes dtypes
            updates, state = update(grads, state, params)
        params = optax.apply_updates(params, updates)
        found.append(updates)
    return found, state


def assert_trees_close(found, expected, rtol=1e-6, atol=1e-7):
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=rtol, atol=atol), found, expected
    )


@pytest.mark.parametrize("b1", [0.9, 0.0])
@pytest.mark.parametrize("b2", [0.999, 0.0])
def test_without_filters_it_is_adam(b1, b2, dtype):
    params = {"a": random(4, 3, dtype=dtype), "b": random(2, dtype=dtype, seed=9)}
    found, _ = steps(filtered_adam(0.1, b1, b2, 1e-6), params)
    expected, _ = steps(optax.adam(0.1, b1, b2, 1e-6), params)
    assert_trees_close(found, expected, 1e-5 if dtype == jnp.float32 else 1e-12)
    assert jax.tree.leaves(found)[0].dtype == dtype


@pytest.mark.parametrize("dtype", [jnp.bfloat16, jnp.float16])
def test_coarse_dtypes_have_the_steps_of_float32(dtype):
    """Where a decay of 0.999 is rounded to one, and an eps of 1e-8 to zero."""
    grads = jnp.array([[0.0, 1.0], [0.01, -1.0]], dtype)

    @jax.jit
    def last(grads):
        optim = filtered_adam(0.1)
        step = lambda carry, _: optim.update(grads, carry[1], grads)
        first = jnp.zeros_like(grads), optim.init(grads)
        return jax.lax.scan(lambda c, x: (step(c, x), None), first, length=1000)[0][0]

    found = last(grads)
    assert found.dtype == dtype
    expected = last(grads.astype(jnp.float32))
    np.testing.assert_allclose(found.astype(jnp.float32), expected, rtol=1e-2)


@pytest.mark.slow
@pytest.mark.parametrize("second_moment", ["filter", "max", "none"])
@pytest.mark.parametrize(("b1", "b2"), [(0.2, 0.36), (0.0, 0.36), (0.2, 0.0), (0.0, 0.0)])
def test_it_is_algorithm_2(b1, b2, second_moment, x64):
    theta = random(6, 5, dtype=jnp.float64)
    before, after = laplacian(1.0, ndim=2), SMOOTH
    optimiser = scale_by_filtered_adam(b1, b2, 1e-3, before, after, second_moment)
    state, m, v = optimiser.init(theta), 0.0, 0.0
    update = jax.jit(optimiser.update)
    for t in range(1, 5):
        grad = random(6, 5, dtype=jnp.float64, seed=t)
        found, state = update(grad, state, theta)
        g = before(grad, theta)
        m, v = b1 * m + (1 - b1) * g, b2 * v + (1 - b2) * g**2
        expected = after(m, theta) / (1 - b1**t)
        if second_moment != "none":
            bottom = after(v, theta) if second_moment == "filter" else v.max()
            expected /= jnp.sqrt(bottom / (1 - b2**t)) + 1e-3
        # what is left of differences of numbers near one has their rounding
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14)
        theta -= 0.1 * found


@pytest.mark.parametrize(
    ("arguments", "arrays"),
    [
        ((0.9, 0.99, "filter"), 3),
        ((0.0, 0.99, "filter"), 2),
        ((0.9, 0.0, "filter"), 2),
        ((0, 0, "filter"), 0),
        ((0.0, 0.0, "max"), 0),
        ((0.0, 0.99, "none"), 0),
        ((0.9, 0.99, "none"), 2),
    ],
)
def test_state_is_no_more_than_needed(arguments, arrays):
    b1, b2, second_moment = arguments
    optimiser = scale_by_filtered_adam(b1, b2, second_moment=second_moment)
    params = jnp.zeros((4, 3))
    state = optimiser.init(params)
    assert len(jax.tree.leaves(state)) == arrays
    _, after = optimiser.update(params, state)
    assert jax.tree.structure(after) == jax.tree.structure(state)


def ratios(seed, filtered):
    """Largest |m| / sqrt(v), first without a filter and then with `filtered` of them filtered."""
    rng = np.random.default_rng(seed)
    b1, b2 = rng.uniform(0, 0.95, 2)
    sizes = np.exp(rng.normal(scale=3, size=(6, 5)))  # gradients of all magnitudes side by side
    guide = jnp.asarray(rng.normal(size=(6, 5)))
    m, v = np.zeros((6, 5)), np.zeros((6, 5))
    for _ in range(rng.integers(1, 6)):
        g = sizes * rng.normal(size=(6, 5))
        m, v = b1 * m + (1 - b1) * g, b2 * v + (1 - b2) * g**2
    smooth = jax.jit(SMOOTH)
    m_after = smooth(jnp.asarray(m), guide) if "m" in filtered else m
    v_after = smooth(jnp.asarray(v), guide) if "v" in filtered else v
    return np.max(np.abs(m) / np.sqrt(v)), float(jnp.max(jnp.abs(m_after) / jnp.sqrt(v_after)))


@pytest.mark.parametrize("filtered", ["mv", "m", "v"])
def test_shared_weights_bound_the_step_and_nothing_else_does(filtered, x64):
    before, after = np.array([ratios(seed, filtered) for seed in range(20)]).T
    if filtered == "mv":
        assert np.all(after <= before * (1 + 1e-12))
    else:
        assert np.max(after / before) > 1.5


def test_the_laplacian_bounds_the_step_beside_a_spike():
    # far away the filtered moments are what rounding leaves, of either sign
    grad = jnp.zeros((64, 64)).at[32, 32].set(1e6)
    optimiser = scale_by_filtered_adam(0.0, 0.0, 1e-8, postfilter=laplacian(1.0, ndim=2))
    update, _ = jax.jit(optimiser.update)(grad, optimiser.init(grad), grad)
    assert jnp.all(jnp.abs(update) < 1.001)


@pytest.mark.parametrize("filters", [{"prefilter": SMOOTH}, {"postfilter": SMOOTH}])
def test_filters_need_the_parameters(filters):
    grads = jnp.ones((4, 3))
    for optimiser in (scale_by_filtered_adam(**filters), filter_updates(SMOOTH)):
        with pytest.raises(ValueError, match=r"update\(grads, state, params\)"):
            optimiser.update(grads, optimiser.init(grads))


def test_bad_arguments_are_refused():
    for b in (-0.1, 1.0, float("nan")):
        with pytest.raises(ValueError, match="b1"):
            scale_by_filtered_adam(b1=b)
        with pytest.raises(ValueError, match="b2"):
            filtered_adam(0.1, b2=b)


def test_zero_gradients_leave_the_parameters():
    params = random(6, 5)
    for second_moment in ("filter", "max", "none"):
        optimiser = filtered_adam(0.1, 0.0, 0.0, 1e-8, SMOOTH, SMOOTH, second_moment)
        updates, _ = jax.jit(optimiser.update)(0 * params, optimiser.init(params), params)
        np.testing.assert_array_equal(updates, jnp.zeros((6, 5)))


def test_filter_updates_filters_with_the_parameters():
    params = {"a": random(6, 5), "b": (random(4, 4, 3), None)}
    grads = jax.tree.map(lambda p: random(*p.shape, seed=3), params)
    optimiser = filter_updates(SMOOTH)
    updates, state = optimiser.update(grads, optimiser.init(params), params, value=1.0)
    assert not jax.tree.leaves(state)
    assert_trees_close(updates, jax.tree.map(SMOOTH, grads, params))


@pytest.fixture
def scene():
    return {"image": random(6, 5, 3), "light": random(3, seed=1)}


def test_masked_filters_only_what_it_is_told(scene):
    mask = {"image": True, "light": False}
    grads = jax.tree.map(lambda p: random(*p.shape, seed=3), scene)
    for inner in (filter_updates(SMOOTH), scale_by_filtered_adam(postfilter=SMOOTH)):
        optimiser = optax.masked(inner, mask)
        updates: Any = jax.jit(optimiser.update)(grads, optimiser.init(scene), scene)[0]
        np.testing.assert_array_equal(updates["light"], grads["light"])
        alone: Any = inner.update(grads["image"], inner.init(scene["image"]), scene["image"])[0]
        np.testing.assert_allclose(updates["image"], alone, rtol=1e-5)


def test_multi_transform_leaves_the_others_to_theirs(scene):
    optimiser = optax.multi_transform(
        {"image": filtered_adam(0.1, postfilter=SMOOTH), "other": optax.adam(0.01)},
        {"image": "image", "light": "other"},
    )
    found, _ = steps(optimiser, scene)
    expected, _ = steps(filtered_adam(0.1, postfilter=SMOOTH), scene["image"])
    assert_trees_close([updates["image"] for updates in found], expected, 1e-4)
    expected, _ = steps(optax.adam(0.01), scene["light"])
    assert_trees_close([updates["light"] for updates in found], expected, 1e-4)


def test_hyperparameters_can_be_injected(dtype):
    @optax.inject_hyperparams
    def optimiser(learning_rate, b1, sigma_d):
        smooth = cross_bilateral(sigma_d, 2, ndim=2)
        return filtered_adam(learning_rate, b1=b1, postfilter=smooth)

    params = random(6, 5, dtype=dtype)
    found, state = steps(optimiser(0.1, b1=0.2, sigma_d=0.5), params)
    expected, _ = steps(filtered_adam(0.1, 0.2, postfilter=SMOOTH), params)
    assert_trees_close(found, expected, 1e-5)
    grads = random(6, 5, dtype=dtype, seed=7)
    changed: Any = state
    hyperparams = {**changed.hyperparams, "sigma_d": jnp.asarray(0, dtype)}
    changed = changed._replace(hyperparams=hyperparams)
    update = jax.jit(optimiser(0.1, b1=0.2, sigma_d=0.5).update)
    with jax.numpy_dtype_promotion("standard"):
        before, after = (update(grads, s, params)[0] for s in (state, changed))
    assert not np.allclose(before, after)


def test_hyperparameters_can_be_injected_from_outside():
    inject = optax.inject_hyperparams(filtered_adam, static_args=("prefilter", "postfilter"))
    params = random(6, 5)
    found, _ = steps(inject(0.1, b1=0.0, b2=0.0, postfilter=SMOOTH), params)
    expected, _ = steps(filtered_adam(0.1, 0.0, 0.0, postfilter=SMOOTH), params)
    assert_trees_close(found, expected, 1e-5)


def test_vmap_is_a_loop():
    params, grads = random(3, 6, 5), random(3, 6, 5, seed=1)
    optimiser = scale_by_filtered_adam(0.2, 0.36, postfilter=SMOOTH, second_moment="max")
    states = jax.vmap(optimiser.init)(params)
    found, _ = jax.jit(jax.vmap(optimiser.update))(grads, states, params)
    update = jax.jit(optimiser.update)
    for i in range(3):
        expected, _ = update(grads[i], optimiser.init(params[i]), params[i])
        np.testing.assert_allclose(found[i], expected, rtol=1e-5, atol=1e-6)


def test_one_compilation_serves_all_steps():
    params = random(6, 5)
    optimiser = filtered_adam(0.1, postfilter=SMOOTH)
    traces = []

    @jax.jit
    def update(grads, state, params):
        traces.append(1)
        return optimiser.update(grads, state, params)

    state = optimiser.init(params)
    for i in range(3):
        _, state = update(random(6, 5, seed=i), state, params)
    assert len(traces) == 1


SHARDED = """
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec
from smoothdiff._filtered_adam import filtered_adam
from smoothdiff.filters import cross_bilateral, laplacian

x = jnp.asarray(np.random.default_rng(0).normal(size=(8, 6)), jnp.float32)
mesh = jax.make_mesh((2,), ("rows",), axis_types=(AxisType.Auto,))
rows = NamedSharding(mesh, PartitionSpec("rows"))
optimiser = filtered_adam(
    0.1, prefilter=laplacian(1.0, ndim=2), postfilter=cross_bilateral(0.5, 2, ndim=2)
)
found = []
for params in (x, jax.device_put(x, rows)):
    state = jax.jit(optimiser.init)(params)
    updates, state = jax.jit(optimiser.update)(params**2, state, params)
    found.append(np.asarray(updates))
assert len(jax.devices()) == 2
np.testing.assert_allclose(*found, rtol=1e-4, atol=1e-6)
"""


@pytest.mark.slow
def test_sharded_arrays(devices):
    done = subprocess.run(
        [sys.executable, "-c", SHARDED], env=devices(2), capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_it_descends_on_sampled_gradients_of_a_function_with_steps():
    # a picture of two flat halves, seen in sixteen levels of grey, from 32 renders a step
    target = jnp.where(jnp.arange(12)[None, :] < 6, 0.2, 0.8) * jnp.ones((12, 1))
    seen = lambda image: jnp.round(15 * image) / 15
    loss = lambda image, args: jnp.sum((seen(image) - seen(target)) ** 2)
    filter = cross_bilateral(0.1, 3, ndim=2)

    def error(optimiser):
        solver = FirstOrder(optimiser, 0.1, num_samples=32)
        start = jnp.full((12, 12), 0.5) + 0.01 * target  # edges are where the guide has a hint
        result = minimise(loss, start, key=jax.random.key(0), solver=solver, max_steps=60)
        return float(jnp.sqrt(jnp.mean((result.history[-1].y - target) ** 2)))

    with jax.numpy_dtype_promotion("standard"):
        plain, filtered = (
            error(filtered_adam(0.03, 0.2, 0.36, postfilter=f)) for f in (None, filter)
        )
    assert filtered < 0.5 * plain


def test_parameters_may_be_numbers_of_python():
    optim = filtered_adam(0.1)
    updates: Any = optim.update({"a": jnp.ones(())}, optim.init({"a": 0.0}), {"a": 0.0})[0]
    np.testing.assert_allclose(updates["a"], -0.1, rtol=1e-5)
