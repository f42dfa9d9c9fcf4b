"""Large Steps: the published trajectory, its special cases, and how it composes with optax."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from benchmarks.scenes.meshes import cube, icosphere
from smoothdiff._filtered_adam import filtered_adam
from smoothdiff._large_steps import large_steps
from smoothdiff.filters import mesh_bilateral, mesh_laplacian

POSITIONS, FACES = icosphere(2)
LAM = 19.0
TARGET = POSITIONS * (1 + 0.3 * np.sin(5 * POSITIONS[:, :1]))


def loss(x, target):
    return jnp.sum((x - target) ** 2 + (x - target) ** 4)


def first_updates(optimiser, gradient, x) -> Any:
    return jax.jit(optimiser.update)(gradient, optimiser.init(x), x)[0]


def trajectory(optimiser, x, target, steps):
    @jax.jit
    def run(x):
        def step(carry, _):
            x, state = carry
            updates, state = optimiser.update(jax.grad(loss)(x, target), state, x)
            x = optax.apply_updates(x, updates)
            return (x, state), x

        return jax.lax.scan(step, (x, optimiser.init(x)), length=steps)[1]

    return run(x)


def reparameterised(x, target, steps, rate, b1, b2):
    """AdamUniform on u = (I + λL) x, dense and in numpy, from the paper's four lines."""
    n = len(x)
    matrix = np.eye(n)
    edges = {
        tuple(sorted(pair)) for f in FACES for pair in ((f[0], f[1]), (f[1], f[2]), (f[2], f[0]))
    }
    for i, j in edges:
        matrix[[i, j], [i, j]] += LAM
        matrix[[i, j], [j, i]] -= LAM
    inverse = np.linalg.inv(matrix)
    gradient = jax.jit(jax.grad(loss))
    u, m, v, seen = matrix @ x, 0.0, 0.0, []
    for t in range(1, steps + 1):
        g = inverse @ np.asarray(gradient(jnp.asarray(inverse @ u), jnp.asarray(target)))
        m, v = b1 * m + (1 - b1) * g, b2 * v + (1 - b2) * g**2
        u = u - rate * (m / (1 - b1**t)) / (1e-8 + np.sqrt(np.max(v / (1 - b2**t))))
        seen.append(inverse @ u)
    return np.array(seen)


@pytest.mark.parametrize(("b1", "b2"), [(0.9, 0.99), (0.9, 0.999), (0.0, 0.0), (0.5, 0.0)])
def test_the_trajectory_is_that_of_the_reparameterised_form(b1, b2, x64):
    x, target = jnp.asarray(POSITIONS), jnp.asarray(TARGET)
    found = trajectory(large_steps(0.05, FACES, LAM, b1, b2), x, target, 50)
    expected = reparameterised(POSITIONS, TARGET, 50, 0.05, b1, b2)
    assert np.abs(expected[-1] - POSITIONS).max() > 0.1  # it went somewhere
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


def test_without_smoothing_and_memory_it_is_gradient_descent_of_unit_length(dtype):
    x, target = jnp.asarray(POSITIONS, dtype), jnp.asarray(TARGET, dtype)
    gradient = np.asarray(jax.jit(jax.grad(loss))(x, target))
    optimiser = large_steps(0.1, FACES, 0.0, 0.0, 0.0)
    updates = first_updates(optimiser, gradient, x)
    assert updates.dtype == dtype
    expected = -0.1 * gradient / np.max(np.abs(gradient))
    np.testing.assert_allclose(updates, expected, rtol=1e-5, atol=1e-8)


def test_without_decay_nothing_is_kept():
    optimiser = large_steps(0.1, FACES, LAM, b1=0.0, b2=0.0)
    assert jax.tree.leaves(optimiser.init(jnp.asarray(POSITIONS, jnp.float32))) == []


def test_it_comes_closer_than_the_bare_gradient_for_its_length():
    """The point of it: no bump of a single vertex, although its gradient is one."""
    x = jnp.asarray(POSITIONS, jnp.float32)
    spike = np.zeros_like(x)
    spike[0] = 1
    optimiser = large_steps(0.1, FACES, LAM)
    updates = np.asarray(first_updates(optimiser, spike, x))
    others = np.linalg.norm(updates[1:], axis=1)
    assert np.max(others) > 0.5 * np.linalg.norm(updates[0])


def test_a_zero_gradient_moves_nothing():
    x = jnp.asarray(POSITIONS, jnp.float32)
    optimiser = large_steps(0.1, FACES, LAM)
    np.testing.assert_array_equal(first_updates(optimiser, np.zeros_like(x), x), 0)


def test_schedules_masks_and_labels(x64):
    params = {"vertices": jnp.asarray(POSITIONS), "albedo": jnp.ones((5, 7))}
    grads = jax.tree.map(jnp.ones_like, params) | {"vertices": jnp.asarray(TARGET)}
    schedule = optax.exponential_decay(0.1, 10, 0.6)
    alone = large_steps(schedule, FACES, LAM)
    expected = first_updates(alone, grads["vertices"], params["vertices"])
    masked = optax.masked(alone, {"vertices": True, "albedo": False})
    labelled = optax.multi_transform(
        {"mesh": alone, "rest": optax.sgd(1.0)}, {"vertices": "mesh", "albedo": "rest"}
    )
    for optimiser in (masked, labelled):
        updates = first_updates(optimiser, grads, params)
        # some are zero but for rounding
        rounding = 8 * np.finfo(float).eps * np.max(np.abs(expected))
        np.testing.assert_allclose(updates["vertices"], expected, rtol=1e-12, atol=rounding)
        np.testing.assert_array_equal(jnp.abs(updates["albedo"]), 1)


def test_injected_hyperparameters():
    x, gradient = jnp.asarray(POSITIONS, jnp.float32), jnp.asarray(TARGET, jnp.float32)
    injected = optax.inject_hyperparams(large_steps, static_args=("faces", "lam"))(
        learning_rate=0.1, faces=FACES, lam=LAM
    )
    plain = large_steps(0.1, FACES, LAM)
    found = first_updates(injected, gradient, x)
    expected = first_updates(plain, gradient, x)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-7)


def test_many_meshes_at_once(x64):
    optimiser = large_steps(0.1, FACES, LAM)
    several = jnp.stack([POSITIONS, 2 * POSITIONS])
    gradients = jnp.stack([TARGET, -TARGET])
    updates = jax.vmap(lambda g, x: first_updates(optimiser, g, x))(gradients, several)
    for x, gradient, found in zip(several, gradients, updates, strict=True):
        expected = first_updates(optimiser, gradient, x)
        # some are zero but for rounding
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-14)


def test_the_bilateral_postfilter_is_a_drop_in():
    """The paper's own optimiser for meshes: Large Steps with another filter of m."""
    positions, faces = cube(4)
    x = jnp.asarray(positions, jnp.float32)
    make = lambda post: filtered_adam(
        0.1, prefilter=mesh_laplacian(faces, LAM), postfilter=post, second_moment="max"
    )
    gradient = jnp.asarray(positions**3, jnp.float32)
    wide, plain = make(mesh_bilateral(faces, LAM, 1e9, 0.4)), large_steps(0.1, faces, LAM)
    found = first_updates(wide, gradient, x)
    expected = first_updates(plain, gradient, x)
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_it_needs_the_parameters():
    x = jnp.asarray(POSITIONS, jnp.float32)
    optimiser = large_steps(0.1, FACES, LAM)
    with pytest.raises(ValueError, match=r"update\(grads, state, params\)"):
        optimiser.update(x, optimiser.init(x))


@pytest.mark.parametrize(
    ("faces", "says"),
    [
        ([[0, 1]], r"shape \(faces, 3\)"),
        ([[0, 1, 1.5]], "astype"),
        ([[0, 1, -2]], "from 0"),
    ],
)
def test_bad_faces_are_refused(faces, says):
    with pytest.raises(ValueError, match=says):
        large_steps(0.1, faces, LAM)


def test_faces_beyond_the_vertices_are_refused():
    x = jnp.zeros((3, 3))
    optimiser = large_steps(0.1, [[0, 1, 5]], LAM)
    with pytest.raises(ValueError, match="index 5, but there are 3 vertices"):
        optimiser.update(x, optimiser.init(x), x)
