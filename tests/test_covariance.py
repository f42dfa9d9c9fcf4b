"""The errors of least-squares parameters: closed forms, coverage, and where there are none."""

import dataclasses
import pickle
import warnings
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.special import stdtrit

import smoothdiff as sd
from smoothdiff._covariance import balance, covariance, slopes
from smoothdiff._solvers._history import History
from smoothdiff._solvers._point_by_point import PointState
from tests.parts import quick_of

KEY = jax.random.key(0)
DESIGN = np.float32(np.random.default_rng(9).standard_normal((20, 4)) * [1, 3, 0.1, 1])
START, TRUTH = {"a": 1.0, "b": 1.0}, {"a": 2.0, "b": 1.3}


def times():
    """In the default dtype."""
    return jnp.linspace(0.0, 3.0, 30)


# with parameters of one structure steps are compiled once


def line(y):
    return y["a"] * times() + y["b"]


def decay(y):
    return y["a"] * jnp.exp(-y["b"] * times())


def wave(y):
    return y["a"] * jnp.cos(times() + y["b"])


def noisy(model, y, size, key=KEY):
    values = model(y)
    return values + size * jax.random.normal(key, values.shape, values.dtype)


def fitted(model, data, y0=START, **settings) -> Any:
    return sd.least_squares(lambda y, data: model(y) - data, y0, data, key=KEY, **settings)


def expected(model, result):
    """s^2 (J^T J)^-1, with JAX's Jacobian."""
    y, tree = ravel_pytree(result.y)
    j = np.asarray(jax.jit(jax.jacobian(lambda y: model(tree(y))))(y), float)
    return 2 * result.fun / (len(j) - len(y)) * np.linalg.inv(j.T @ j)


# closed forms


def test_of_linear_residuals_it_is_the_closed_form(dtype):
    result = fitted(line, noisy(line, TRUTH, 0.3))
    np.testing.assert_allclose(result.covariance, expected(line, result), rtol=1e-4)
    errors = result.parameter_errors
    assert jax.tree.structure(errors) == jax.tree.structure(result.y)
    assert errors["a"].dtype == dtype
    flat = np.sqrt(np.diag(result.covariance))
    np.testing.assert_allclose(ravel_pytree(errors)[0], flat, rtol=1e-6)


@pytest.mark.slow
def test_of_curved_residuals_it_is_that_of_the_jacobian(x64):
    result = fitted(decay, noisy(decay, TRUTH, 0.1))
    np.testing.assert_allclose(result.covariance, expected(decay, result), rtol=0.01)


@pytest.mark.slow
def test_intervals_are_students(x64):
    result = fitted(line, noisy(line, TRUTH, 1.0))
    for level in (0.95, 0.5):
        reach = stdtrit(28, (1 + level) / 2)
        for name, error in result.parameter_errors.items():
            ends = [end[name] for end in result.parameter_intervals(level)]
            np.testing.assert_allclose(
                ends, [result.y[name] - reach * error, result.y[name] + reach * error]
            )
    with pytest.raises(ValueError, match="between 0 and 1"):
        result.parameter_intervals(95.0)


@pytest.mark.slow
def test_a_space_gives_errors_in_natural_values(x64):
    """The same as without it; on a logarithmic scale intervals are factors."""
    data = noisy(decay, TRUTH, 0.05)
    space = {"a": sd.Range(0.1, 10.0, log=True), "b": sd.Positive()}
    result = fitted(decay, data, space=space)
    np.testing.assert_allclose(result.covariance, expected(decay, result), rtol=0.02)
    low, high = result.parameter_intervals()
    for name, y in result.y.items():
        np.testing.assert_allclose(low[name] * high[name], y**2)
        factor = np.exp(stdtrit(28, 0.975) * result.parameter_errors[name] / y)
        np.testing.assert_allclose(high[name] / y, factor)


@pytest.mark.slow
def test_an_angle_has_its_error_at_the_end_of_its_period(x64):
    data = noisy(wave, {"a": 2.0, "b": 3.15}, 0.1)
    space = {"a": None, "b": sd.Periodic(low=-np.pi)}
    result = fitted(wave, data, {"a": 1.5, "b": -3.1}, space=space)
    np.testing.assert_allclose(result.covariance, expected(wave, result), rtol=0.01)
    low, high = (end["b"] for end in result.parameter_intervals())
    np.testing.assert_allclose((low + high) / 2, result.y["b"])


# where there are none


@pytest.mark.slow
def test_a_parameter_at_a_bound_is_fixed_for_the_others(x64):
    result = fitted(line, noisy(line, TRUTH, 0.3), bounds=(-10.0, {"a": 10.0, "b": 1.0}))
    assert result.y["b"] == 1
    with pytest.warns(UserWarning, match=r"^no error of b, at a bound"):
        errors = result.parameter_errors
    assert np.isnan(errors["b"])
    variance = 2 * result.fun / 29 / np.sum(times() ** 2)
    np.testing.assert_allclose(errors["a"], np.sqrt(variance), rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "unknown"),
    [
        (lambda y: y[0] * times() + y[1], [2]),
        (lambda y: (y[0] + y[2]) * times() + y[1], [0, 2]),
    ],
)
def test_what_the_residuals_do_not_depend_on_is_nan(model, unknown):
    data = noisy(model, np.array([2, -1, 0], np.float32), 0.3)
    result = fitted(model, data, jnp.zeros(3), max_steps=40)
    names = ", ".join(f"y[{j}]" for j in unknown)
    with pytest.warns(UserWarning, match="no error of " + names.replace("[", r"\[")):
        errors = np.asarray(result.parameter_errors)
    assert np.flatnonzero(np.isnan(errors)).tolist() == unknown
    design = np.stack([times(), np.ones(30)], axis=1)
    closed = np.sqrt(2 * result.fun / 27 * np.diag(np.linalg.inv(design.T @ design)))
    known = [j for j in range(2) if j not in unknown]
    np.testing.assert_allclose(errors[known], closed[known], rtol=1e-3)
    more: Any = sd.with_covariance(lambda y, data: model(y) - data, result, data)
    with pytest.warns(UserWarning, match="Either they do not, or only on a combination"):
        errors = np.asarray(more.parameter_errors)
    assert np.flatnonzero(np.isnan(errors)).tolist() == unknown


def test_as_many_parameters_as_residuals_have_none():
    result = fitted(lambda y: jnp.stack([y["a"], y["b"]]), jnp.zeros(2), max_steps=2)
    with pytest.warns(UserWarning, match="2 residuals of 2 parameters"):
        assert np.all(np.isnan(result.covariance))


@pytest.mark.slow
def test_other_solvers_have_none():
    result = sd.minimise(lambda y, _: jnp.sum(y**2), jnp.ones(2), key=KEY, max_steps=1)
    assert (result.covariance, result.parameter_errors) == (None, None)
    with pytest.raises(ValueError, match=r"only results of sd\.least_squares"):
        result.parameter_intervals()
    many = sd.least_squares(lambda y, _: y - 1, jnp.ones(100), key=KEY, max_steps=1)
    assert many.covariance is None
    with pytest.raises(ValueError, match=r"only results of sd\.least_squares"):
        sd.with_covariance(lambda y, _: jnp.sum(y**2), result)


# further evaluations


def test_a_run_that_was_cut_short_needs_more_evaluations():
    data = noisy(decay, TRUTH, 0.1)
    result = fitted(decay, data, TRUTH, max_steps=3)
    with pytest.warns(UserWarning, match=r"4 evaluations of sd\.with_covariance"):
        assert np.isnan(result.covariance).all()
    calls = []

    def fun(y):
        calls.append(y)
        return np.asarray(decay(y) - data)

    box = sd.black_box(fun, jax.ShapeDtypeStruct((30,), jnp.float32))
    more: Any = result
    for count in (4, 8):
        more: Any = sd.with_covariance(lambda y, _: box(y), more)
        assert len(calls) == count
        assert more.evaluations == result.evaluations + count
    np.testing.assert_allclose(more.covariance, expected(decay, more), rtol=0.05)
    assert more.y == result.y
    with pytest.raises(ValueError, match="fun returned 7 residuals, and 30 in the run"):
        sd.with_covariance(lambda y, _: jnp.ones(7), result)
    swapped: Any = (result, lambda y, _: jnp.ones(30))
    with pytest.raises(TypeError, match=r"not function: write sd\.with_covariance\(fun, result\)"):
        sd.with_covariance(*swapped)


def test_where_the_function_takes_a_key_a_warning_says_to_give_one():
    fun = lambda y, data, key: noisy(line, y, 0.1, key) - data
    settings = {"key": KEY, "takes_key": True, "max_evaluations": 12}
    result: Any = sd.least_squares(fun, START, noisy(line, TRUTH, 0.3), **settings)
    with pytest.warns(UserWarning, match=r"no error of a, b.*result, args, key=key\)"):
        assert np.all(np.isnan(result.covariance))
    assert np.isnan(result.stderr)


def test_jumps_within_the_further_evaluations_are_named():
    steps = lambda y: jnp.round(decay(y))
    data = noisy(steps, TRUTH, 0.1)
    result = fitted(steps, data, TRUTH, max_steps=3)
    more: Any = sd.with_covariance(lambda y, data: steps(y) - data, result, data)
    with pytest.warns(UserWarning, match=r"jump or curve.*sd\.with_covariance.* again"):
        assert np.isnan(more.covariance).all()


@pytest.mark.slow
def test_the_search_that_found_the_answer_tells_its_errors():
    tone = lambda y: y["a"] * jnp.sin(y["b"] * times())
    truth = {"a": 2.0, "b": 8.0}
    data = noisy(tone, truth, 0.1)
    # several frequencies are minima, and with other starts most searches end in the others
    solver = sd.GaussNewton(0.3, restarts=6, patience=40)
    bounds = {"a": 0.5, "b": 1.0}, {"a": 4.0, "b": 20.0}
    result: Any = fitted(tone, data, truth, solver=solver, bounds=bounds, max_evaluations=400)
    here = np.stack(jax.tree.leaves(result.y))
    assert not np.any(np.all(np.asarray(result.state.search.history.points) == here, axis=1))
    np.testing.assert_allclose(result.covariance, expected(tone, result), rtol=0.3, atol=3e-5)


def test_of_equal_searches_the_last_has_the_answer():
    def history(place, lowest):
        rows, funs = jnp.ones((3, 2)), jnp.array([2.0, lowest, -1])
        return History.of(jnp.full((3, 1), place), rows, funs, jnp.array([True, True, False]))

    def place(found, here) -> Any:
        state: Any = SimpleNamespace(found=found, search=SimpleNamespace(history=here))
        return PointState.around_lowest(state).points[0, 0]

    assert place(history(1.0, 0), history(2.0, 0)) == 2
    assert place(history(1.0, 0), history(2.0, 1)) == 1
    assert place(history(1.0, 1), history(2.0, 0)) == 2


def test_an_answer_that_the_history_lost_is_evaluated_again():
    data = noisy(decay, TRUTH, 0.1)
    result = fitted(decay, data, TRUTH, max_steps=25)
    history = result.state.search.history
    empty = jax.tree.map(jnp.zeros_like, history)
    state = eqx.tree_at(lambda s: s.search.history, result.state, empty)
    lost = dataclasses.replace(result, state=state)
    with pytest.warns(UserWarning, match="no error of a, b"):
        assert np.isnan(lost.covariance).all()
    more: Any = sd.with_covariance(lambda y, data: decay(y) - data, lost, data)
    assert more.evaluations == result.evaluations + 5
    again: Any = sd.with_covariance(lambda y, data: decay(y) - data, more, data)
    np.testing.assert_allclose(again.covariance, expected(decay, result), rtol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(("sigma", "calls"), [(0.2, 5), (None, 8)])
def test_ripples_on_logarithmic_ranges_are_no_slopes(sigma, calls):
    """A few calls give the closed form of the function without its jumps.

    After first points that are farther away, by default, it takes a few more.
    """
    phases = 30 * jax.random.normal(jax.random.key(7), (60, 4))
    t = jnp.linspace(0.0, 3.0, 60)
    curve = lambda y: y["a"] * jnp.exp(-y["b"] * t) * jnp.cos(y["w"] * t + y["c"])

    def rippled(y):
        phase = phases @ jnp.log(ravel_pytree(y)[0])
        return curve(y) + 0.03 * (phase - jnp.floor(phase) - 0.5)

    truth = {"a": 2.0, "b": 0.4, "w": 6.0, "c": 0.3}
    space = {name: sd.Range(1e-3, 10.0, log=True, sigma=sigma) for name in truth}
    data = noisy(curve, truth, 0.3)
    result = fitted(rippled, data, truth, space=space, max_steps=12)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # it says what is not known yet
        for _ in range(calls):
            result = sd.with_covariance(lambda y, data: rippled(y) - data, result, data)
    errors = ravel_pytree(result.parameter_errors)[0]
    np.testing.assert_allclose(errors, np.sqrt(np.diag(expected(curve, result))), rtol=0.2)


def test_a_result_can_be_kept_in_a_file():
    result = fitted(line, noisy(line, TRUTH, 1.0))
    kept = pickle.loads(pickle.dumps(result))
    np.testing.assert_array_equal(kept.covariance, result.covariance)


# the regression itself


@pytest.mark.parametrize("noise", [0.0, 1e-3, 0.03])
def test_noise_of_the_function_is_no_information(noise):
    """Weak slopes beside noise: without a correction errors would be too small."""
    rng = np.random.default_rng(1)
    jacobian = rng.standard_normal((200, 3)) * [1.0, 1.0, 0.05]
    points = rng.standard_normal((40, 3)) * [0.3, 1.0, 1.0]
    points[7] = 0
    rows = 1 + points @ jacobian.T + noise * rng.standard_normal((40, 200))
    found = covariance(slopes(points, rows, 7), 200, 197.0, np.zeros(3, bool))
    closed = np.linalg.inv(jacobian.T @ jacobian)
    np.testing.assert_allclose(np.diag(found.matrix), np.diag(closed), rtol=1e-9 + 5 * noise)
    assert found.freedom == 197


def test_curvature_is_no_noise():
    """Near points outweigh far ones by as much as the function asks for."""
    rng = np.random.default_rng(2)
    jacobian = rng.standard_normal((100, 2))
    size = 10 ** rng.uniform(-4, 0.5, (25, 1))
    points = rng.standard_normal((25, 2)) * size
    points[0] = 0
    rows = np.sin(points @ jacobian.T) + (points @ jacobian[::-1].T) ** 2
    found = covariance(slopes(points, rows, 0), 100, 98.0, np.zeros(2, bool))
    np.testing.assert_allclose(found.matrix, np.linalg.inv(jacobian.T @ jacobian), rtol=0.01)


@pytest.mark.parametrize("noise", [1e-4, 1e-2])
def test_further_evaluations_lie_where_noise_and_curvature_are_the_same(noise):
    """At a distance d with noise = 3 d^2; a factor of two is as good as the grid."""
    rng = np.random.default_rng(3)
    jacobian, bend = rng.standard_normal((200, 2)), 3 * rng.standard_normal(200)
    points = rng.standard_normal((40, 2)) * 10 ** rng.uniform(-2.5, 0, (40, 1))
    points[0] = 0
    curved = np.sum(points**2, axis=1, keepdims=True) * bend
    rows = points @ jacobian.T + curved + noise * rng.standard_normal((40, 200))
    known = slopes(points, rows, 0)
    assert known is not None
    along = known.scale * balance(known, np.diag(known.squares))
    np.testing.assert_allclose(np.log(along), np.log((noise / 3) ** 0.5), atol=np.log(2))


def test_too_few_evaluations_tell_nothing():
    points = np.eye(3)[:2]
    assert slopes(points, np.zeros((2, 5)), 0) is None
    found = covariance(None, 5, 1.0, np.zeros(3, bool))
    assert np.all(np.isnan(found.matrix))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "truth", "size"),
    [
        (line, TRUTH, 0.3),
        (lambda y: DESIGN @ y, np.array([1, -2, 0.5, 3], np.float32), 0.5),
        (lambda y: decay({"a": y[0], "b": y[1]}) + y[2], np.array([2, 1.2, 0.5], np.float32), 0.05),
    ],
)
def test_intervals_cover_as_often_as_they_say(model, truth, size):
    """Of 100 data sets each, to three standard errors; of 400 each all shares were 93 to 97 %."""
    fun = lambda y, data: model(y) - data
    y, y0 = ravel_pytree(truth)[0], jax.tree.map(np.ones_like, truth)
    inside = []
    for seed in range(100):
        key, noise = jax.random.split(jax.random.key(seed))
        result = sd.least_squares(fun, y0, noisy(model, truth, size, noise), key=key)
        low, high = (ravel_pytree(end)[0] for end in result.parameter_intervals())
        inside.append((low < y) & (y < high))
    shares = np.mean(inside, axis=0)
    assert np.all(np.abs(shares - 0.95) < 3 * (0.95 * 0.05 / 100) ** 0.5), shares


@pytest.mark.parametrize("share", [0.01, 0.09, 0.3, 1.0])
def test_of_parameters_that_act_together_no_error_is_known(share):
    """Each may be anything if the other goes with it, however little it does."""
    data = times() * (1 + 0.05 * jax.random.normal(KEY, times().shape))
    sum_of_both = lambda y: times() * (y["a"] + share * y["b"])
    result = fitted(sum_of_both, data, {"a": 2.0, "b": 2.0})
    with pytest.warns(UserWarning, match="no error of a, b"):
        assert np.all(np.isnan(result.covariance))
    alone = fitted(lambda y: times() * (y["a"] + 0 * y["b"]), data, {"a": 2.0, "b": 2.0})
    with pytest.warns(UserWarning, match="no error of b"):
        errors = alone.parameter_errors
    assert 0.005 < errors["a"] < 0.05


def test_leaves_of_two_precisions_have_errors(x64):
    model = lambda y: y["a"] * times() + y["b"].astype(times().dtype)
    data = noisy(model, {"a": 2.0, "b": jnp.array(1.3)}, 0.1)
    mixed = fitted(model, data, {"a": 1.0, "b": jnp.float32(1.0)})
    double = fitted(model, data, {"a": 1.0, "b": 1.0})
    for name in ("a", "b"):
        found, known = mixed.parameter_errors[name], double.parameter_errors[name]
        np.testing.assert_allclose(found, known, rtol=1e-3)


@pytest.mark.parametrize("seed", quick_of(range(8), [3]))
def test_rounding_is_no_slope_of_what_changes_nothing_nearby(seed, x64):
    """Residuals have some of it in common, so that it may look like one."""
    angle, whole = sd.Periodic(2 * np.pi), sd.Integer(0, 8)
    space = {"a": sd.Positive(), "b": sd.Range(1e-3, 10, log=True), "c": angle, "k": whole}

    def model(y):
        swings = y["a"] * jnp.exp(-y["b"] * times()) * jnp.cos(3 * times() + y["c"])
        return swings + 0.1 * jnp.asarray(y["k"], float) * times()

    start, truth = ({"a": 1.0, "b": 0.1, "c": 0.1, "k": 1}, {"a": 2.0, "b": 0.5, "c": 0.4, "k": 3})
    data = noisy(model, truth, 0.05, jax.random.key(seed))
    result = fitted(model, data, start, space=space)
    with pytest.warns(UserWarning, match="no error of k, and the others are for them"):
        errors = result.parameter_errors
    assert np.isnan(errors["k"])
    assert 0.005 < errors["a"] < 0.2
