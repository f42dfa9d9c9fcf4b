"""The fit of residuals, what it leaves uncertain, and the evaluation that checks it."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from smoothdiff._solvers._history import History
from smoothdiff._solvers._nearest_fit import Fit, _noise_length
from smoothdiff._solvers._residual_check import check_step, checked, newer
from smoothdiff._solvers._residual_search import ResidualSearch

STEP, CHECKED = jax.jit(check_step), jax.jit(checked)
NEWER, LENGTH = jax.jit(newer), jax.jit(_noise_length)
ONE = np.float32(1)
AXES = np.eye(3, dtype=np.float32)


def fit_of(jacobian: Any, spread: Any) -> Fit:
    as_array = lambda a: jnp.asarray(a, jnp.float32)
    return Fit(as_array(jacobian), as_array(AXES[2]), jnp.asarray(False), as_array(spread))


def history_of(points, rows):
    funs = jnp.sum(rows**2, axis=1) / 2
    return History.of(points, rows, funs, jnp.ones(len(points), bool))


# where the check is


def test_the_check_is_where_most_may_be_hidden():
    """By brute force: the uncertainty of the slopes against the curvature."""
    rng = np.random.default_rng(0)
    for _ in range(5):
        jacobian, spread = rng.normal(size=(3, 8)), rng.normal(size=(3, 3))
        row = rng.normal(size=8).astype(np.float32)
        found = np.asarray(STEP(fit_of(jacobian, spread), row, AXES[0], 1e3 * ONE))
        hidden = lambda u, j=jacobian, s=spread: np.sum((s.T @ u) ** 2) / np.sum((j.T @ u) ** 2)
        assert hidden(found) > 0.999 * max(hidden(u) for u in rng.normal(size=(3000, 3)))
        # the residuals change by two hundredths
        np.testing.assert_allclose(
            np.linalg.norm(jacobian.T @ found), 0.02 * np.linalg.norm(row), rtol=1e-4
        )


def test_the_check_is_no_further_than_that_and_far_enough_to_tell():
    row = np.ones(3, np.float32)
    certain = fit_of(AXES, np.diag([1, 2, 1]))
    np.testing.assert_allclose(np.abs(STEP(certain, row, AXES[0], 1e-2 * ONE)), 0.01 * AXES[1])
    # beside a place of a thousand sigma, the root of its rounding
    tiny = STEP(certain, 1e-9 * row, 1e3 * AXES[0], 1e3 * ONE)
    np.testing.assert_allclose(np.linalg.norm(tiny), 1e3 * np.sqrt(np.finfo(np.float32).eps))


def test_where_residuals_do_not_change_nothing_is_hidden():
    flat = np.diag([1, 1, 0])
    found = np.asarray(STEP(fit_of(flat, np.diag([1, 2, 1e6])), ONE * np.ones(3), AXES[0], ONE))
    assert np.abs(found[2]) < 1e-6 * np.abs(found[1])
    # of all that is flat, what is covered least
    none = STEP(fit_of(np.zeros((3, 3)), AXES), ONE * np.ones(3), AXES[0], 0.5 * ONE)
    np.testing.assert_array_equal(none, 0.5 * AXES[2])


# what it says


def test_a_check_goes_to_the_side_that_is_not_known():
    known = jnp.asarray([[0.0, 0.0, 0.0], [0.9, 0.0, 0.0]])
    for step in (AXES[0], -AXES[0]):
        np.testing.assert_array_equal(NEWER(step, known), -AXES[0])


@pytest.mark.parametrize(("off", "right"), [(0.0, True), (0.5, False), (-0.5, False)])
def test_a_check_is_right_if_the_loss_rises_as_predicted(off, right):
    """An error of the slopes by which most of the rise is missed hardly changes a residual."""
    row, across = np.array([100, 0], np.float32), np.array([0, 2], np.float32)
    foreseen = 2.0
    there = row + across + np.array([off * foreseen / 100, 0], np.float32)
    said = CHECKED(row, there, row + across, np.float32(0), jnp.asarray(True))
    assert bool(said.right) == right
    # a wrong one is followed by a nearer one
    assert float(said.factor) == pytest.approx(0.8 if right else 0.5)


def test_a_badly_scaled_parameter_is_checked():
    """In float32 the curvature of the second is a rounding of that of the first."""
    row = np.ones(3, np.float32)
    found = np.asarray(STEP(fit_of(np.diag([1, 1e-4, 1]), np.diag([1, 100, 1])), row, 0 * row, ONE))
    assert np.abs(found[1]) > 100 * np.abs(found[0])


# the fit


def test_far_evaluations_count_by_what_a_linear_model_leaves_out():
    """Of noise alone it is as much nearby as farther away, of curvature the square of distances."""
    far = np.array([0, 0.1, 0.2, 0.4, 0.6, 0.8, 1], np.float32)
    length = lambda off: float(LENGTH(np.asarray(off, np.float32), far))
    assert length(np.ones(7)) == 1.5
    np.testing.assert_allclose(length(far**2), 0.15, rtol=1e-5)
    # a floor of noise below curvature: where both are the same, but for the factor
    np.testing.assert_allclose(length(np.hypot(0.04, far**2)), 1.5 * 0.2, rtol=0.05)
    # nothing to go by
    assert length(np.zeros(7)) == 1.5


# a plateau


def test_a_plateau_is_one_of_all_residuals():
    """Sums of squares that are the same by chance are none."""
    points = jnp.asarray([[0.0], [1.0]])

    def plateau(rows) -> bool:
        search = ResidualSearch.of(points[0], history_of(points, jnp.asarray(rows)))
        return bool(search.plateau(jnp.asarray([0.5])))

    assert not plateau([[1.0, 0.0], [0.0, 1.0]])
    assert plateau([[1.0, 0.0], [1.0, 0.0]])
