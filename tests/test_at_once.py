"""Evaluations that run at once: steps at several radii, and points beside the model's step."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from parts import quick_of

import smoothdiff as sd
from smoothdiff._solvers._at_once import beside, radii

ZERO, ONE, NONE = jnp.asarray(0, jnp.int32), jnp.asarray(1.0), jnp.asarray(0.0)
FREE = lambda points: points
# compiled, as in a solver
RADII, BESIDE = jax.jit(radii, static_argnums=1), jax.jit(beside, static_argnums=(4, 5))


def test_one_evaluation_is_the_step():
    assert RADII(jnp.asarray(0.5), 1).tolist() == [0.5]
    step = np.ones(3, np.float32)
    points, others = BESIDE(step[None], step, ONE, NONE, FREE, 1, ZERO)
    assert (points.tolist(), others.tolist()) == ([3 * [1]], [False])


@pytest.mark.parametrize(
    ("count", "factors"), [(2, [1]), (3, [1, 2]), (4, [1, 2]), (5, [1, 2, 0.5]), (9, [1, 2, 0.5])]
)
def test_half_of_the_evaluations_are_steps_and_at_most_three(count, factors):
    np.testing.assert_allclose(RADII(jnp.asarray(3.0), count), 3.0 * np.array(factors))


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_points_beside_a_step_lie_on_one_axis_after_the_other(x64, dtype):
    step = np.array([3.0, 4.0], dtype)
    steps = np.stack([step, 2 * step, step / 2])
    found = []
    for turn in (0, 7):
        one, none = jnp.ones((), dtype), jnp.zeros((), dtype)
        points, others = BESIDE(steps, step, one, none, FREE, 7, ZERO + turn)
        assert points.dtype == dtype
        assert others.tolist() == 3 * [False] + 4 * [True]
        np.testing.assert_array_equal(np.asarray(points)[:3], steps)
        found += ((np.asarray(points)[3:] - step) / 4).tolist()
    axes = [[0, 1], [-1, 0], [0, -1], [1, 0]]
    np.testing.assert_allclose(found[:4], axes, atol=1e-6)
    assert len({tuple(np.round(one).tolist()) for one in found}) == 4


def test_a_step_that_comes_twice_makes_way_for_a_point_beside_it():
    step = np.array([3.0, 4.0], np.float32)
    steps = np.stack([step, step * (1 + 1e-5), step / 2])
    points, others = BESIDE(steps, step, jnp.asarray(9.0), NONE, FREE, 3, ZERO)
    assert others.tolist() == [False, True, False]
    assert np.linalg.norm(np.asarray(points)[1] - step) == pytest.approx(4)


def test_beside_no_step_points_depend_on_the_radius():
    step = np.zeros(2, np.float32)
    points, _ = BESIDE(step[None], step, jnp.asarray(0.5), NONE, FREE, 2, ZERO)
    assert np.linalg.norm(np.asarray(points)[1]) == pytest.approx(0.4)


def test_beside_a_tiny_step_points_can_be_told_apart():
    step = np.array([1e-12, 0.0], np.float32)
    points, _ = BESIDE(step[None], step, ONE, jnp.asarray(0.5), FREE, 3, ZERO)
    away = np.asarray(points)[1:] - step
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), 0.4, rtol=1e-6)


@pytest.mark.parametrize("step", [[-1.0], [1.0, 0.0], [0.0, -2.0]])
@pytest.mark.parametrize("count", [2, 4])
def test_points_beside_a_step_along_an_axis_are_new(step, count):
    step = np.array(step, np.float32)
    factors = np.asarray(RADII(ONE, count))
    for turn in range(0, 4 * count, count):
        points, _ = BESIDE(factors[:, None] * step[None], step, ONE, NONE, FREE, count, ZERO + turn)
        points = np.concatenate([np.zeros((1, len(step))), points])
        apart = np.linalg.norm(points[:, None] - points[None], axis=2) + np.eye(len(points))
        assert np.min(apart) > 0.15 * np.linalg.norm(step)


def test_points_beside_a_step_are_within_the_bounds():
    step, inside = np.array([0.0, 1.0], np.float32), lambda points: jnp.clip(points, -1, 1)
    for turn in range(0, 8, 2):
        points, _ = BESIDE(step[None], step, ONE, NONE, inside, 2, ZERO + turn)
        assert np.max(np.abs(points)) <= 1
        assert np.linalg.norm(np.asarray(points)[1] - step) == pytest.approx(0.8)


@pytest.mark.parametrize("count", quick_of([1, 2, 4, 8], [4]))
@pytest.mark.parametrize("residuals", quick_of([False, True], [True]))
def test_so_many_at_once_solve_a_quadratic_in_fewer_steps(x64, count, residuals):
    bend = jnp.array([[1.0, 0.3, 0.0], [0.0, 2.0, 0.5], [0.0, 0.0, 0.7]])
    rows = lambda y, args: bend @ (y - jnp.array([1.0, -0.5, 2.0]))
    call: Any = sd.minimise
    solver: Any = sd.NewtonCG(0.3, num_samples=count)
    fun = lambda y, args: jnp.sum(rows(y, args) ** 2)
    if residuals:
        call, fun, solver = sd.least_squares, rows, sd.GaussNewton(0.3, num_samples=count)
    result = call(fun, jnp.zeros(3), key=jax.random.key(0), solver=solver, max_steps=60)
    solved = next(r.step for r in result.history if r.fun < 1e-12)
    determined = 4 if residuals else 10
    assert solved <= determined / count + 5
    assert result.reason == "converged"


def test_a_round_of_samples_is_no_smaller_for_few_at_once():
    y = jnp.zeros(3)
    for solver in (sd.NewtonCG, sd.GaussNewton):
        usual = solver(0.1).sizes(y)
        assert usual is not None
        for count in (1, 2, 3, 16):
            sizes = solver(0.1, num_samples=count).sizes(y)
            assert sizes is not None
            assert sizes.step == count
            assert sizes.first >= usual.first
            assert sizes.first % count == sizes.later % count == 0


@pytest.mark.slow
@pytest.mark.parametrize("count", [4, 8])
def test_a_minimum_of_zero_ends_a_search(count):
    """A check that is right while another point is lower is no reason to go on."""
    fun = lambda y, args: jnp.sum(jnp.array([1.0, 30, 3]) * y**2) + (y[0] * y[1]) ** 2 / 2
    solver = sd.NewtonCG(0.5, num_samples=count)
    evaluations = []
    for seed in range(5):
        start = jnp.array([2.5, 1.3, -0.7]) + 0.1 * seed
        result = sd.minimise(fun, start, key=jax.random.key(seed), solver=solver)
        assert result.reason == "converged"
        evaluations.append(result.evaluations)
    assert np.median(evaluations) < 20 * count
