"""The local model of residuals: its step within a region, its fit, what it makes of an outcome."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from smoothdiff._solvers._bounded_step import bounded_step
from smoothdiff._solvers._evaluator import half_squares
from smoothdiff._solvers._history import History, alike
from smoothdiff._solvers._residual_trust import Proposal, TrustRegion

STEP = jax.jit(bounded_step)
NONE = None, None
ONES: Any = np.ones(3)


def quadratic(seed, n=4, shift=0.0):
    """A random Hessian, with eigenvalues that `shift` may make negative, and a gradient."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n))
    return root @ root.T - shift * np.eye(n), rng.normal(size=n)


def value(hessian, grad, p):
    return grad @ p + p @ hessian @ p / 2


@pytest.mark.parametrize("shift", [0.0, 3.0])
def test_the_step_is_the_minimiser_within_the_radius(shift, x64):
    """More and Sorensen: (H + s I) p = -g with H + s I positive, s >= 0, s (|p| - r) = 0."""
    for seed in range(5):
        hessian, grad = quadratic(seed, shift=shift)
        for radius in (0.01, 0.3, 100.0):
            p = np.asarray(STEP(hessian, grad, jnp.asarray(radius), *NONE))
            assert np.linalg.norm(p) <= radius * (1 + 1e-6)
            slope = hessian @ p + grad
            multiplier = -slope @ p / (p @ p)
            np.testing.assert_allclose(
                slope, -multiplier * p, atol=1e-5 * float(np.linalg.norm(grad))
            )
            assert multiplier >= max(0, -np.linalg.eigvalsh(hessian)[0]) - 1e-6
            assert multiplier * (radius - np.linalg.norm(p)) < 1e-4 * radius


def test_bounds_hold_and_little_is_lost_to_them(x64):
    low, high = -0.2 * np.ones(4), np.array([0.1, 0.3, 0.05, 0.2])
    for seed in range(5):
        hessian, grad = quadratic(seed)
        p = np.asarray(STEP(hessian, grad, jnp.asarray(10.0), low, high))
        assert np.all((p >= low) & (p <= high))
        best = scipy.optimize.minimize(
            lambda q, h=hessian, g=grad: value(h, g, q),
            np.zeros(4),
            bounds=list(zip(low, high, strict=True)),
        )
        assert value(hessian, grad, p) < 0.99 * best.fun


def test_bounds_that_are_far_away_change_nothing(x64):
    for seed in range(5):
        hessian, grad = quadratic(seed)
        radius, far = jnp.asarray(0.3), 10 * np.ones(4)
        free = STEP(hessian, grad, radius, *NONE)
        np.testing.assert_allclose(STEP(hessian, grad, radius, -far, far), free, rtol=1e-6)


@pytest.mark.parametrize("factor", [1e-30, 1.0, 1e15])
def test_a_step_is_finite_whatever_the_scale(factor):
    hessian, grad = (np.float32(factor * part) for part in quadratic(0))
    p = np.asarray(STEP(hessian, grad, np.float32(0.3), *NONE))
    assert np.all(np.isfinite(p))
    assert np.linalg.norm(p) == pytest.approx(0.3, rel=1e-3)
    flat = np.asarray(STEP(0 * hessian, 0 * grad, np.float32(0.3), *NONE))
    assert np.all(np.isfinite(flat))


# compiled, as in a solver
PROPOSE, REVISE = eqx.filter_jit(TrustRegion.propose), eqx.filter_jit(TrustRegion.revise)
START, BEST = jax.jit(TrustRegion.start, static_argnums=(1, 2)), jax.jit(History.best)
JACOBIAN = np.random.default_rng(3).normal(size=(3, 7))


@jax.jit
def filled(points, rows):
    empty = History.empty(12, 3, 7, points.dtype)
    funs, good = half_squares(rows), jnp.ones(len(points), bool)
    return empty.after(points, rows, funs, good, jnp.asarray(len(points)))


def known(points, rows=None):
    """A history at these points, of the linear residuals 1 + y J if of no others."""
    points = np.asarray(points)
    return filled(points, 1 + points @ JACOBIAN if rows is None else rows)


def propose(trust, history):
    center, row, _ = BEST(history, np.zeros(3))
    proposal = PROPOSE(trust, history, center, row, ONES, NONE, 1, jnp.asarray(0, jnp.int32))
    return proposal, center, row


def test_n_plus_one_points_give_the_jacobian_of_a_linear_function(x64):
    history = known(np.concatenate([np.zeros((1, 3)), np.eye(3)]))
    proposal, *_ = propose(START(jnp.asarray(1.0), 3, 7), history)
    np.testing.assert_allclose(proposal.jacobian, JACOBIAN, atol=1e-6)
    assert not proposal.poor


def test_directions_that_no_point_has_keep_the_old_jacobian(x64):
    history = known([[0, 0, 0], [1.0, 0, 0]])
    old = np.ones((3, 7))
    trust = START(jnp.asarray(1.0), 3, 7)
    trust = eqx.tree_at(lambda t: t.jacobian, trust, jnp.asarray(old))
    proposal, *_ = propose(trust, history)
    expected = np.concatenate([JACOBIAN[:1], old[1:]])
    np.testing.assert_allclose(proposal.jacobian, expected, atol=1e-6)
    assert proposal.poor


def outcome(fun, trust=None, predicted=0.5, ahead=0.0, check=False, lost=False):
    """The region after a step of length one from 1, where half of that was predicted."""
    one = jnp.ones((1, 1))
    proposal = Proposal(
        points=one,
        others=jnp.zeros(1, bool),
        predicted=predicted * one,
        reduction=(1 - predicted**2) / 2 * jnp.ones(1),
        slope=jnp.ones(1),
        ahead=jnp.asarray(ahead),
        jacobian=one,
        poor=jnp.asarray(False),
        check=jnp.asarray(check),
        lost=jnp.full(1, lost),
    )
    trust = trust or START(jnp.asarray(1.0), 1, 1)
    row = jnp.full((1, 1), fun)
    return REVISE(trust, proposal, jnp.ones(1), row, jnp.isfinite(row[:, 0]))


def test_the_radius_follows_the_acceptance_ratio():
    assert outcome(0.5).radius == 2  # as predicted
    assert outcome(0.9).radius == 1  # lower, but by less
    assert 0.1 <= outcome(1.2).radius <= 0.5  # higher
    assert outcome(50.0).radius == pytest.approx(0.1)
    for anything in (jnp.nan, jnp.inf):
        assert outcome(anything).radius == pytest.approx(0.1)


def test_a_step_that_comes_to_nothing_in_rounding_is_no_failure_after_steps_that_came_true():
    settled = outcome(0.51, lost=True)
    assert settled.fails == 0
    settled = eqx.tree_at(lambda t: t.settled, settled, jnp.asarray(True))
    for fun in (1.0, 1.5):
        lost = outcome(fun, settled, lost=True)
        assert (lost.fails, lost.rough, lost.radius) == (0, 0, settled.radius)
        assert lost.settled
        # nothing came true yet, or nothing is there
        assert outcome(fun, lost=True).fails == 1
    assert outcome(np.inf, settled, lost=True).fails == 1
    # one that comes true is a step like any other
    assert outcome(0.51, settled, lost=True).worked


@pytest.mark.parametrize(
    ("length", "center", "radius", "lost"),
    [
        (1e-15, 1.0, 1.0, True),
        (1e-9, 1.0, 1.0, False),
        (1e-15, 0.0, 1.0, True),
        (1e-12, 0.0, 1.0, False),
        (1e-15, 1.0, 5e-16, False),  # the radius made it short
        (1e-3, 1e13, 1.0, False),  # rounding is no small matter there
    ],
)
def test_a_step_is_lost_within_a_few_roundings_of_the_parameters(length, center, radius, lost, x64):
    away = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    middle: Any = np.full(3, center)
    rows = (away + length * np.eye(3)[:1]) @ JACOBIAN
    history = known(center + away, rows)
    at = jnp.asarray(0, jnp.int32)
    trust = START(jnp.asarray(radius), 3, 7)
    proposal = PROPOSE(trust, history, middle, rows[0], ONES, NONE, 1, at)
    assert float(proposal.points[0, 0]) == pytest.approx(-min(length, radius), rel=1e-3)
    assert bool(proposal.lost[0]) == lost


def test_a_check_says_whether_the_model_is_right_or_is_followed_by_another():
    """The model promises nothing, and predicts residuals of 2 where there were 1."""
    before = START(jnp.asarray(1.0), 1, 1)
    checked = lambda there: outcome(there, before, predicted=2.0, check=True)
    right = checked(2.05)
    assert right.right
    assert right.settled
    assert right.slow == 0
    assert float(right.radius) == pytest.approx(0.8)
    valley = outcome(2.05, before, predicted=2.0, ahead=0.1, check=True)
    assert not valley.right
    assert not valley.settled
    for wrong in (2.2, 1.5, jnp.nan):  # nearer
        assert not checked(wrong).right
        assert float(checked(wrong).radius) == 0.5
    near = eqx.tree_at(lambda t: t.radius, before, jnp.asarray(0.01))
    for there in (1.00001, 0.99999):
        little = outcome(there, near, predicted=1.00002, check=True)  # farther
        assert not little.right
        assert float(little.radius) == pytest.approx(0.04)
        assert float(outcome(there, before, predicted=1.00002, check=True).radius) == 1
    lower = checked(0.5)
    assert (bool(lower.right), float(lower.radius)) == (False, 0.5)
    plateau = checked(1.0)  # as before
    assert not plateau.right
    assert float(plateau.radius) == 0.5


def test_a_radius_that_is_too_small_for_a_promise_is_no_convergence():
    """What the model promises further on counts, unless it promises nothing there either."""
    before = eqx.tree_at(
        lambda t: (t.settled, t.radius), outcome(0.5), (jnp.asarray(True), jnp.asarray(1.0))
    )
    assert outcome(1.0, before, predicted=1.0, ahead=0.0).settled
    assert not outcome(1.0, before, predicted=1.0, ahead=0.1).settled


def test_steps_that_change_nothing_or_are_predicted_no_better_are_rough():
    assert outcome(1.0).failed()
    smooth = outcome(1.2)
    assert not smooth.failed()
    again = outcome(1.2, smooth)
    assert again.fails == 2
    # what has worked before is given more time
    worked = outcome(0.5)
    assert not outcome(1.0, worked).failed()


def test_a_step_that_was_far_too_long_says_nothing_against_the_model():
    long = outcome(50.0)
    assert (long.fails, long.rough) == (0, 0)
    assert long.radius == pytest.approx(0.1)
    # nor does it say anything for it
    assert outcome(50.0, outcome(1.2)).fails == 1
    assert outcome(jnp.inf).fails == 1


def test_the_best_point_stays_in_the_history(x64):
    history = known([[0.0, 0, 0]])
    best = np.array([[0.5, 0.5, 0.5]])
    history = jax.jit(History.after)(
        history, best, np.zeros((1, 7)), np.zeros(1), np.ones(1, bool), 1
    )

    @jax.jit
    def followed(history, point, rows):
        new = History.of(point, rows, jnp.sum(rows**2, axis=1) / 2, jnp.ones(1, bool))
        return history.followed_by(new, True)

    for i in range(40):
        history = followed(history, np.full((1, 3), float(i)), np.full((1, 7), 1.0 + i))
    point, row, _ = BEST(history, np.zeros(3))
    np.testing.assert_array_equal(point, best[0])
    np.testing.assert_array_equal(row, np.zeros(7))
    assert history.points[-1, 0] == 39


def test_rows_are_alike_to_the_last_bit(dtype):
    row = np.random.default_rng(0).normal(size=500).astype(dtype)
    nearly = row.copy()
    nearly[7] = np.nextafter(row[7], row.dtype.type(9))
    rows = np.stack([row, nearly, row, -row, np.full_like(row, np.inf)])
    np.testing.assert_array_equal(jax.jit(alike)(rows, row), [True, False, True, False, False])
