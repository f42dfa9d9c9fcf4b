"""Steps by a Jacobian whose entries are found: against the dense solution."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from smoothdiff._solvers._local_steps import TRIED, local_steps, steps_to_try

RNG = np.random.default_rng(0)
N, SIZE, BATCHES, COUNT = 60, 40, 3, 100


def banded() -> np.ndarray:
    """Each residual sees two parameters."""
    matrix = np.zeros((SIZE, N))
    matrix[np.arange(SIZE), np.arange(SIZE)] = 1
    matrix[np.arange(SIZE), np.arange(SIZE) + 20] = RNG.uniform(0.5, 1, SIZE)
    return matrix


stepped = jax.jit(local_steps)
MATRIX = banded()
HERE = RNG.normal(size=SIZE)


def samples(dtype):
    """Batches around iterates far from each other, on a linear function."""
    points = RNG.normal(size=(BATCHES, COUNT, N)) + 30 * RNG.normal(size=(BATCHES, 1, N))
    residuals = HERE + points @ MATRIX.T
    return points.astype(dtype), residuals.astype(dtype)


def test_a_sparse_linear_problem_is_solved_at_once(dtype):
    points, residuals = samples(dtype)
    here = HERE.astype(dtype)
    steps = stepped(points, residuals, np.ones((BATCHES, COUNT), bool), here, None, None)
    left = np.sum((here + np.asarray(steps) @ MATRIX.T) ** 2, axis=1)
    assert left[-1] < 0.01 * np.sum(here**2)
    # the larger the damping the shorter the step
    assert np.all(np.diff(np.linalg.norm(steps, axis=1)) > 0)


def test_what_does_not_count_has_no_say(x64):
    points, residuals = samples(float)
    valid = np.ones((BATCHES, COUNT), bool)
    valid[0] = valid[1, ::2] = False
    spoilt = np.where(valid[..., None], residuals, 1e6)
    here = HERE
    first = stepped(points, residuals, valid, here, None, None)
    second = stepped(points, spoilt, valid, here, None, None)
    np.testing.assert_array_equal(first, second)


def test_a_parameter_at_a_bound_stays_there(x64):
    points, residuals = samples(float)
    low, high = np.zeros(N), np.full(N, 9.0)
    ones = np.ones((BATCHES, COUNT), bool)
    free = stepped(points, residuals, ones, HERE, None, None)
    held = np.asarray(stepped(points, residuals, ones, HERE, low, high))
    outwards = np.asarray(free[0] < 0)
    np.testing.assert_array_equal(held[:, outwards], 0)
    assert np.any(held[:, ~outwards] != 0)


@pytest.mark.parametrize("residual", [0.0, 1.0])
def test_where_nothing_is_seen_there_is_no_step(residual):
    points = RNG.normal(size=(1, 20, 5)).astype(np.float32)
    residuals = np.full((1, 20, 3), residual, np.float32)
    steps = stepped(points, residuals, np.ones((1, 20), bool), residuals[0, 0], None, None)
    np.testing.assert_array_equal(steps, 0)


def test_a_jacobian_too_large_to_write_down_leaves_the_lengths():
    n, size = 20_001, 10_000
    out = jax.eval_shape(
        lambda: steps_to_try(
            jnp.ones(n),
            jnp.ones((4, n)),
            jnp.ones((4, size)),
            jnp.ones(4, bool),
            jnp.ones(size),
            2,
            None,
            None,
        )
    )
    assert out.shape == (TRIED, n)
