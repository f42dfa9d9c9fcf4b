"""The quadratic model within a trust region that Newton-CG uses point by point."""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from smoothdiff._params import take_apart
from smoothdiff._solvers._bounded_step import bounded_step
from smoothdiff._solvers._history import History
from smoothdiff._solvers._least_change import least_change
from smoothdiff._solvers._model_check import to_new_place
from smoothdiff._solvers._quadratic_trust import QuadraticTrust

N = 3
ROOT = np.random.default_rng(0).normal(size=(N, N))
HESSIAN = ROOT @ ROOT.T + np.eye(N)
BEST = np.array([0.3, -0.2, 0.5])


def bowl(x):
    return 2.0 + (x - BEST) @ HESSIAN @ (x - BEST) / 2


@jax.jit
def filled(points, funs):
    empty = History.empty(40, N, 1, points.dtype)
    good, count = jnp.ones(len(points), bool), jnp.asarray(len(points))
    return empty.after(points, funs[:, None], funs, good, count)


def known(points, fun=bowl):
    """A history of the function at these points."""
    points = np.asarray(points)
    return filled(points, np.array([fun(x) for x in points], points.dtype))


def around(count, width=1.0):
    first = [np.zeros(N), *np.eye(N), *-np.eye(N)]
    more = np.random.default_rng(1).normal(size=(20, N))
    return width * np.array([*first, *more][:count])


# compiled, as in a solver
START, REVISE = eqx.filter_jit(QuadraticTrust.start), eqx.filter_jit(QuadraticTrust.revise)
STEP, MODEL = jax.jit(bounded_step), jax.jit(least_change)


@eqx.filter_jit
def propose(trust, history, bounds=None, count=1):
    params = take_apart(jnp.zeros(N), jnp.ones(N), bounds)
    center, _, fun = history.best(jnp.zeros(N))
    zero = jnp.asarray(0, jnp.int32)
    return trust.propose(history, center, fun, params, count, zero), center, fun


def proposal_of(history, radius=10.0, bounds=None, count=1):
    trust = START(jnp.ones(N), jnp.asarray(radius))
    proposal, center, fun = propose(trust, history, bounds, count)
    return trust, proposal, np.asarray(center), float(fun)


@pytest.mark.parametrize("width", [1.0, 1e-6, 1e6])
def test_ten_points_determine_a_quadratic_in_three_dimensions(x64, width):
    history = known(around(10, width), lambda x: bowl(x / width))
    _, proposal, center, fun = proposal_of(history, 10 * width)
    np.testing.assert_allclose(proposal.hessian * width**2, HESSIAN, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(center + proposal.points[0], BEST * width, rtol=1e-3)
    assert proposal.reduction[0] == pytest.approx(fun - 2, rel=1e-3)


def test_two_n_plus_one_points_give_the_gradient_and_the_diagonal(x64):
    _, proposal, *_ = proposal_of(known(around(2 * N + 1)))
    np.testing.assert_allclose(np.diag(proposal.hessian), np.diag(HESSIAN), rtol=1e-6)
    # of the other entries nothing is known, and nothing is made up
    assert np.max(np.abs(proposal.hessian - np.diag(np.diag(proposal.hessian)))) < 0.5


def test_one_value_that_is_huge_does_not_spoil_the_model(x64):
    points = np.concatenate([around(15), np.full((1, N), 2.0)])
    fun = lambda x: 1e30 if np.all(x == 2) else bowl(x)
    _, proposal, center, _ = proposal_of(known(points, fun))
    np.testing.assert_allclose(center + proposal.points[0], BEST, atol=1e-2)


def test_bounds_hold_and_the_rest_is_minimised(x64):
    high = jnp.array([0.1, 9.0, 9.0])
    _, proposal, center, _ = proposal_of(known(around(10)), bounds=(-9 * jnp.ones(N), high))
    found = center + proposal.points[0]
    rest = np.linalg.solve(HESSIAN[1:, 1:], -HESSIAN[1:, 0] * (0.1 - BEST[0])) + BEST[1:]
    np.testing.assert_allclose(found, [0.1, *rest], atol=1e-4)


def test_several_steps_at_once_have_several_radii(x64):
    _, proposal, *_ = proposal_of(known(around(10)), radius=0.01, count=6)
    assert proposal.others.tolist() == 3 * [False] + 3 * [True]
    lengths = np.linalg.norm(proposal.points[:3], axis=1)
    np.testing.assert_allclose(lengths, [0.01, 0.02, 0.005], rtol=1e-6)


def test_a_point_beside_a_step_says_nothing_of_the_step(x64):
    trust, proposal, _, fun = proposal_of(known(around(10)), radius=0.01, count=2)
    good = jnp.ones(2, bool)
    values = jnp.asarray([fun, fun - 1])  # the step failed, the point beside it is lower
    after = REVISE(trust, proposal, jnp.asarray(fun), values, good)
    assert after.fails == 1


def test_the_radius_follows_the_ratio_and_the_metric_the_hessian(x64):
    trust, proposal, _, fun = proposal_of(known(around(10, 0.05)), radius=0.05)
    good = jnp.ones(1, bool)
    outcome = lambda value: REVISE(trust, proposal, jnp.asarray(fun), jnp.asarray([value]), good)
    kept = outcome(fun - float(proposal.reduction[0]))
    assert kept.radius > 0.06
    assert outcome(fun + 1).radius < 0.03
    assert outcome(np.inf).fails == 1
    # a step that was far too long says nothing against the model
    long = outcome(fun + 100 * float(proposal.reduction[0]))
    assert long.fails == 0
    assert long.radius < 0.006
    # towards the shape in which the Hessian is round
    before, after = (np.linalg.cond(h) for h in (proposal.hessian, kept.hessian))
    assert after < before


def test_it_is_stuck_after_five_failures_in_a_row_and_failed_without_a_radius(x64):
    trust, proposal, _, fun = proposal_of(known(around(10)))
    for _ in range(5):
        assert not trust.stuck()
        trust = REVISE(trust, proposal, jnp.asarray(fun), jnp.asarray([fun + 1]), jnp.ones(1, bool))
    assert trust.stuck()
    assert not trust.failed()
    assert not trust.retried().stuck()
    assert trust.retried().radius == trust.radius
    assert not trust.revived(jnp.asarray(1.0)).stuck()
    assert START(jnp.ones(N), jnp.asarray(1e-16)).failed()


def test_it_predicts_once_two_more_steps_came_true_than_did_not(x64):
    trust, proposal, _, fun = proposal_of(known(around(10)))
    predicts = []
    for came_true in (True, True, True, False, False, True):
        change = float(proposal.reduction[0]) * (-1 if came_true else 1)
        values = jnp.asarray([fun + change])
        trust = REVISE(trust, proposal, jnp.asarray(fun), values, jnp.ones(1, bool))
        predicts.append(bool(trust.predicts()))
    assert predicts == [False, True, True, True, False, True]
    assert not trust.revived(jnp.asarray(1.0)).predicts()


def test_where_the_model_is_flat_the_step_is_for_the_geometry(x64):
    _, proposal, *_ = proposal_of(known(around(7), lambda x: 1.0), radius=0.5)
    assert proposal.reduction[0] == 0
    assert np.linalg.norm(proposal.points[0]) == pytest.approx(0.5, rel=1e-3)


@pytest.mark.parametrize("count", [1, 6])
def test_a_point_for_the_geometry_is_where_the_farthest_evaluation_says_most(count, x64):
    """By its polynomial, over the ball; the other steps stay as they are."""
    history = known(np.array([*around(7), [3.0, 3.0, 1.0]]), lambda x: bowl(x) + x[0] ** 3)
    trust = START(jnp.ones(N), jnp.asarray(0.7))
    steps, center, fun = propose(trust, history, None, count)
    improving = eqx.tree_at(lambda t: t.improve, trust, jnp.asarray(True))
    found, *_ = propose(improving, history, None, count)
    np.testing.assert_allclose(found.points[1:], steps.points[1:], atol=1e-12)
    model = MODEL(history, center, fun, trust.metric, trust.radius, trust.hessian)
    constant, slope, bend = model.polynomial
    size = lambda u: np.abs(constant + u @ slope + np.sum(u @ bend * u, axis=1) / 2)
    u = np.random.default_rng(2).normal(size=(20_000, N))
    u *= (
        0.7
        * np.random.default_rng(3).uniform(size=(len(u), 1))
        / np.linalg.norm(u, axis=1)[:, None]
    )
    assert size(found.points[:1])[0] >= np.max(size(u))


def of_check(trust, proposal, fun, rise):
    return REVISE(trust, proposal, fun, jnp.asarray([fun + rise]), jnp.ones(1, bool))


def test_a_check_is_where_the_model_knows_least(x64):
    """Of a plane of points it is off that plane, within the bounds, and promises nothing."""
    normal = np.array([1.0, 2.0, 2.0]) / 3
    plane = around(12, 0.3) @ (np.eye(N) - np.outer(normal, normal))
    history, high = known(plane), jnp.full(N, 0.2)
    for bounds in (None, (-9 * jnp.ones(N), high)):
        trust = START(jnp.ones(N), jnp.asarray(0.3))
        trust = dataclasses.replace(trust, check=jnp.asarray(True))
        proposal, center, fun = propose(trust, history, bounds)
        step = np.asarray(proposal.points[0])
        assert proposal.reduction[0] == 0
        if bounds is None:
            assert abs(step @ normal) == pytest.approx(0.3, rel=1e-6)
            # where a model knows nothing, it has not converged
            assert not of_check(trust, proposal, fun, 1.0).settled
        else:
            assert np.all(center + step <= 0.2 + 1e-12)
            assert abs(step @ normal) > 0.15
        # it neither fails nor is it followed by another
        after = partial(of_check, trust, proposal, fun)
        assert (after(1.0).fails, after(1.0).check) == (0, False)
        assert after(1.0).radius == pytest.approx(0.3)


def test_only_a_model_that_is_right_about_a_check_may_have_converged(x64):
    history = known([*around(10), BEST])
    trust = START(jnp.ones(N), jnp.asarray(0.3))
    trust = dataclasses.replace(trust, check=jnp.asarray(True))
    proposal, _, fun = propose(trust, history)
    after = partial(of_check, trust, proposal, fun)
    right = [bool(after(share * proposal.rise).settled) for share in (1, 0.7, 0.3, 3, -1)]
    assert right == [True, True, False, False, False]


def test_a_radius_that_is_too_small_for_a_promise_grows():
    history = known(around(10, 1e-3).astype(np.float32))
    trust, proposal, _, fun = proposal_of(history, radius=1e-7)
    assert proposal.tight
    after = REVISE(trust, proposal, jnp.asarray(fun), jnp.asarray([fun]), jnp.ones(1, bool))
    assert after.radius == pytest.approx(2e-7)
    assert not after.settled


@pytest.mark.parametrize("seed", range(4))
def test_a_shape_is_a_change_of_coordinates(x64, seed):
    rng = np.random.default_rng(seed)
    hessian, grad, root = rng.normal(size=(N, N)), rng.normal(size=N), rng.normal(size=(N, N))
    hessian, root = hessian + hessian.T, root + 3 * np.eye(N)
    inverse = np.linalg.inv(root)
    far, radius = np.full(N, 1e6), jnp.asarray(0.7)
    round_ = STEP(inverse @ hessian @ inverse.T, inverse @ grad, radius, None, None)
    shaped = STEP(hessian, grad, radius, -far, far, root @ root.T)
    np.testing.assert_allclose(root.T @ shaped, round_, rtol=1e-4, atol=1e-6)


def test_it_works_in_float32_and_under_vmap():
    history = known(around(10).astype(np.float32))
    params = take_apart(jnp.zeros(N), jnp.ones(N), None)
    center, _, fun = jax.jit(History.best)(history, np.zeros(N, np.float32))

    def step(radius):
        trust = QuadraticTrust.start(params.sigma, radius)
        return trust.propose(history, center, fun, params, 1, jnp.asarray(0, jnp.int32)).points[0]

    steps = jax.jit(jax.vmap(step))(jnp.array([0.1, 10.0]))
    assert steps.dtype == jnp.float32
    np.testing.assert_allclose(center + steps[1], BEST, atol=1e-3)
    assert np.linalg.norm(steps[0]) == pytest.approx(0.1, rel=1e-3)


def test_evaluations_that_all_came_back_to_the_center_leave_the_others_in_the_model(x64):
    """As steps below rounding do; the nearest 2 n + 1 would else be one point."""
    again = np.zeros((2 * N + 3, N))
    history = known(np.concatenate([around(2 * N + 1), again]), lambda x: x @ x)
    _, proposal, *_ = proposal_of(history)
    np.testing.assert_allclose(proposal.hessian, 2 * np.eye(N), atol=1e-6)


def test_a_step_within_rounding_says_nothing_against_the_model(x64):
    trust, proposal, _, fun = proposal_of(known(around(10)))
    higher = jnp.asarray([fun + 1]), jnp.ones(1, bool)
    lost = proposal._replace(lost=jnp.ones_like(proposal.lost))
    after = REVISE(trust, lost, jnp.asarray(fun), *higher)
    assert (after.radius, after.fails) == (trust.radius, 0)


@pytest.mark.parametrize(("radius", "shrinks"), [(4.0, True), (0.4, False)])
def test_near_points_replace_far_ones_before_a_small_radius_shrinks(x64, radius, shrinks):
    trust, proposal, _, fun = proposal_of(known(around(10)), radius=radius)
    poor = proposal._replace(poor=jnp.asarray(True))
    for _ in range(4):
        trust = REVISE(trust, poor, jnp.asarray(fun), jnp.asarray([fun + 1e-9]), jnp.ones(1, bool))
        assert trust.improve
    assert (trust.radius < radius) == shrinks
    assert not trust.stuck()


def test_points_that_do_not_determine_a_quadratic_are_not_met_exactly(x64):
    """The straight part of a function with a kink is believed more than the far side of it."""
    kink = lambda x: bowl(x) + 10 * np.maximum(x[0] - 0.5, 0)
    hessians = [np.asarray(proposal_of(known(around(count), kink))[1].hessian) for count in (9, 10)]
    assert np.linalg.norm(hessians[0] - HESSIAN) < np.linalg.norm(hessians[1] - HESSIAN)


def test_a_check_is_at_no_known_point():
    known = jnp.asarray([[0.0, 0.0], [1.0, 0.05], [-1.0, 0.0], [0.5, 0.0]])
    ends = jnp.asarray([[1.0, 0.0], [-1.0, 0.0]])
    rise = lambda steps: jnp.sum(steps**2, axis=1)
    place = lambda known, least: to_new_place(ends, known, rise, jnp.asarray(least))
    # the opposite comes before a half, of which a quarter must be more than rounding
    np.testing.assert_array_equal(place(known[:2], 0.0), [-1, 0])
    np.testing.assert_array_equal(place(known, 0.0), [-0.5, 0])
    np.testing.assert_array_equal(place(known, 0.5), [1, 0])
    # the farthest, where all are known
    steps = [2.0**-k * end for k in range(4) for end in ends]
    shifted = jnp.stack([step * (1.01 if k < 7 else 1.09) for k, step in enumerate(steps)])
    np.testing.assert_array_equal(place(shifted, 0.0), steps[7])
