"""The shortest calls: what is chosen, when a run ends, what wrong arguments are told."""

import logging
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest
from closed_forms import as_users_have_it

import smoothdiff as sd
from smoothdiff._default_solver import default_solver
from tests.parts import quick_of

KEY = jax.random.key(0)
minimise, least_squares = as_users_have_it(sd.minimise), as_users_have_it(sd.least_squares)
TARGET = (1.0, -2.0, 0.5)


def bowl(y, args):
    return jnp.sum((y - jnp.array(TARGET, y.dtype)) ** 2)


def valley(y, args):
    return jnp.array([10 * (y[1] - y[0] ** 2), 1 - y[0]])


def cubes(y, args):
    return y**3 - jnp.array(TARGET, y.dtype)


def stairs(y, args):
    return jnp.sum(jnp.floor(4 * jnp.abs(y - jnp.array(TARGET, y.dtype))))


# what is chosen


@pytest.mark.slow
def test_few_parameters_get_newton_cg_and_residuals_gauss_newton(x64):
    result = sd.minimise(bowl, jnp.ones(3), key=KEY)
    assert isinstance(result.solver, sd.NewtonCG)
    assert (result.reason, result.result) == ("converged", optx.RESULTS.successful)
    np.testing.assert_allclose(result.y, TARGET, atol=1e-4)
    result = sd.least_squares(valley, jnp.array([-1.2, 1.0]), key=KEY)
    assert isinstance(result.solver, sd.GaussNewton)
    assert result.reason == "converged"
    np.testing.assert_allclose(result.value, 1, atol=1e-4)
    assert result.evaluations < 100
    assert result.stats["fun"] == result.fun


@pytest.mark.parametrize("above", quick_of([1, 100], [100]))
def test_a_run_ends_where_only_rounding_is_left(above):
    """In float32 the last steps promise less than the value can tell."""
    bent = np.array([1, 10, 100], np.float32)
    fun = lambda y, args: jnp.sum(bent * (y - 1) ** 2) / 2 + above
    result = sd.minimise(fun, jnp.zeros(3), key=KEY)
    assert result.reason == "converged"
    np.testing.assert_allclose(result.fun, above, rtol=1e-6)
    assert result.evaluations < 25


@pytest.mark.slow
def test_many_parameters_get_first_order_and_a_support_its_own_solver():
    y0 = jnp.zeros(100)
    result = sd.minimise(lambda y, _: jnp.sum((y - 1) ** 2), y0, key=KEY, max_steps=30)
    assert isinstance(result.solver, sd.FirstOrder)
    assert result.fun < 90
    terms = lambda y, _: jnp.where(y > 0.1, 1.0, y)
    result = sd.least_squares(
        terms, y0, key=KEY, sigma=0.2, support=lambda y: y, max_evaluations=400
    )
    assert isinstance(result.solver, sd.LocalGaussNewton)


@pytest.mark.parametrize(
    ("chosen", "change"),
    [
        (sd.LocalCrossEntropy, {}),
        (sd.LocalGaussNewton, {"sigma": 0.2}),
        (sd.LocalGaussNewton, {"bounds": (0.0, np.inf)}),
        (sd.LocalGaussNewton, {"bounds": (0.0, None)}),
        (sd.LocalGaussNewton, {"bounds": None}),
        (sd.LocalGaussNewton, {"support": sd.moving_support(lambda at: lambda y: y)}),
        (sd.LocalGaussNewton, {"support": sd.local_support(6, ndim=1)}),
    ],
)
def test_a_term_with_few_parameters_within_bounds_gets_cross_entropy(chosen, change):
    call = {"bounds": (0.0, 1.0), "sigma": None, "support": lambda y: y} | change
    sigma = call["sigma"]
    bounds, support = call["bounds"], call["support"]
    found = default_solver(jnp.zeros(100), bounds, sigma, True, support, sigma is None)
    assert isinstance(found, chosen)


@pytest.mark.parametrize(
    ("y0", "bounds", "sigma"),
    [
        ({"a": 0.0, "b": np.array([3.0, -5.0])}, None, {"a": 0.2, "b": [1.0, 1.0]}),
        ({"a": 1e-6, "b": 0.0}, (-1.0, 4.0), {"a": 1.0, "b": 1.0}),
        ({"a": 2.0, "b": 2.0}, (None, {"a": 3.0, "b": 12.0}), {"a": 0.4, "b": 0.4}),
        (np.array([2.0, 2.0]), (np.array([1.0, -np.inf]), 3.0), [0.4, 0.4]),
    ],
)
def test_sigma_is_a_share_of_the_range_or_of_the_start(y0, bounds, sigma):
    total = lambda y, _: sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(y))
    result = sd.minimise(total, y0, key=KEY, bounds=bounds, max_steps=1)
    expected = jax.tree.leaves(sigma, is_leaf=lambda s: isinstance(s, list))
    for one, other in zip(jax.tree.leaves(result.solver.sigma), expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6)


@pytest.mark.parametrize(
    ("size", "bounds", "sigma"),
    [(2, (-1.0, 4.0), 2.0), (2, None, 0.6), (2, (-1.0, None), 0.6), (100, (-1.0, 4.0), 1.0)],
)
def test_residuals_point_by_point_begin_with_two_fifths_of_a_range(size, bounds, sigma):
    found = default_solver(jnp.full(size, 3.0), bounds, None, residuals=True)
    np.testing.assert_allclose(found.sigma, np.full(size, sigma), rtol=1e-6)


TIMES = np.linspace(0, 4, 20)
CURVES = {
    "decay": (lambda a, b, c, t: a * jnp.exp(-b * t) + c, (3.0, 1.5, 0.5)),
    "logistic": (lambda a, b, c, t: a / (1 + jnp.exp(-b * (t - c))), (5.0, 2.0, 1.5)),
    "stretched": (lambda a, b, c, t: a * jnp.exp(-((t / b) ** c)), (4.0, 1.2, 0.7)),
}


@pytest.mark.slow
@pytest.mark.parametrize("run", [sd.minimise, sd.least_squares])
def test_bounds_far_too_wide_cost_a_start_nearby_few_evaluations(run, x64):
    """A twentieth and ten times of the answer, from half to twice of it, until 1e-4 is left."""

    def took(name, seed, bounded):
        curve, found = CURVES[name]
        answer = jnp.array(found)
        y0 = answer * jax.random.uniform(jax.random.key(seed), (3,), minval=0.6, maxval=1.6)
        at = lambda y: curve(y[0], y[1], y[2], TIMES)
        rows = lambda y, args: at(jnp.maximum(y, 1e-3)) - at(answer)
        fun = rows if run is sd.least_squares else lambda y, args: jnp.sum(rows(y, args) ** 2) / 2
        bounds = (answer / 20, 10 * answer) if bounded else None
        target = 1e-4 * jnp.sum(rows(y0, None) ** 2) / 2
        given = {"key": KEY, "target": target, "max_evaluations": 200}
        return run(fun, y0, bounds=bounds, **given).evaluations

    cases = [(name, seed) for name in CURVES for seed in range(12)]
    without, within = ([took(*case, bounded) for case in cases] for bounded in (False, True))
    assert np.median(within) < 1.35 * np.median(without)


def test_a_schedule_of_sigma_sets_the_steps_of_many_parameters():
    falls = lambda step: 0.4 / (1 + step)
    options = {"sigma": falls, "max_steps": 3, "keep_iterates": True}
    result = sd.minimise(lambda y, _: jnp.sum(y**2), jnp.ones(100), key=KEY, **options)
    np.testing.assert_allclose([r.sigma for r in result.history], [0.4, 0.2, 0.4 / 3], rtol=1e-6)
    # a first step of Adam is 0.15 sigma of each parameter
    np.testing.assert_allclose(np.abs(np.asarray(result.history[0].y) - 1), 0.15 * 0.4, rtol=1e-3)


@pytest.mark.parametrize(("run", "width"), [(sd.minimise, 0.2), (sd.least_squares, 0.4)])
@pytest.mark.parametrize("own", [None, 0.1])
def test_a_space_and_the_same_bounds_have_one_default(run, width, own):
    low, high = jnp.array([-1.0, 0.0]), jnp.array([1.0, 4.0])
    fun = (lambda y, _: y) if run is sd.least_squares else (lambda y, _: jnp.sum(y**2))
    y0 = jnp.array([0.0, 1.0])
    call = lambda **where: run(fun, y0, key=KEY, max_steps=1, **where).solver.sigma
    found = call(space=sd.Range(low, high, sigma=own))
    np.testing.assert_allclose(found, np.full(2, own or width), rtol=1e-6)
    if own is None:
        bounded = call(bounds=(low, high)) / (high - low)
        np.testing.assert_allclose(bounded, np.full(2, width), rtol=1e-6)


@pytest.mark.parametrize("space", [True, False])
def test_residuals_from_near_an_end_of_a_range_begin_with_less_of_it(space):
    """The root of a start's distance from the end, within a tenth of the range; at least a quarter.

    A sigma that is given, by the space or the call, is as it is given.
    """
    low, high = jnp.zeros(5), jnp.full(5, 10.0)
    y0 = jnp.array([5.0, 1.0, 9.75, 0.01, 0.0])
    where: dict[str, Any] = {"space": sd.Range(low, high)} if space else {"bounds": (low, high)}
    call = lambda **more: (
        sd.least_squares(lambda y, _: y, y0, key=KEY, max_steps=1, **(where | more)).solver.sigma
    )
    scale = 1 if space else 10
    expected = 0.4 * np.array([1, 1, 0.5, 0.25, 0.25])
    np.testing.assert_allclose(call() / scale, expected, rtol=1e-5)
    np.testing.assert_allclose(call(sigma=0.3), 0.3, rtol=1e-6)
    if space:
        own = call(space=sd.Range(low, high, sigma=0.3))
        np.testing.assert_allclose(own, np.full(5, 0.3), rtol=1e-6)
    # numbers are looked at by another solver
    number = sd.minimise(lambda y, _: jnp.sum(y**2), y0, key=KEY, max_steps=1, **where)
    np.testing.assert_allclose(number.solver.sigma / scale, np.full(5, 0.2), rtol=1e-6)


@pytest.mark.parametrize("size", [None, 2])
def test_a_range_for_all_parameters_and_a_start_in_float32_where_float64_is_on(size, x64):
    y0 = jnp.full(() if size is None else size, 0.1, jnp.float32)
    residuals = lambda y, _: jnp.atleast_1d(y - jnp.asarray(3, y.dtype))
    result = sd.least_squares(residuals, y0, key=KEY, bounds=(0.0, 10.0))
    assert all(s.dtype == jnp.float32 for s in jax.tree.leaves(result.solver.sigma))
    np.testing.assert_allclose(result.y, 3, rtol=1e-5)


def test_what_has_one_end_or_a_range_beyond_all_measure_has_no_share_of_its_own(x64):
    lows, highs = np.array([0.0, -1.5e308, -np.inf, 1.0]), np.array([np.inf, 1.5e308, 1.0, 1.0])
    y0 = jnp.array([0.0, 1.0, 1.0, 1.0])
    found = default_solver(y0, (lows, highs), None, residuals=True)
    np.testing.assert_allclose(found.sigma, 0.2)


@pytest.mark.slow
def test_ten_starts_on_stairs_need_no_setting():
    found = [float(sd.minimise(stairs, jnp.zeros(3), key=jax.random.key(k)).fun) for k in range(5)]
    assert np.median(found) <= 1


# when a run ends


def ripples(y, args):
    away = y - jnp.array([0.3, -0.2], y.dtype)
    return jnp.sum(away**2 + 0.3 * (1 - jnp.cos(9 * away)))


@pytest.mark.slow
def test_with_a_target_other_searches_follow_a_local_minimum():
    call = {"bounds": (-3.0, 3.0), "sigma": 0.1, "max_evaluations": 2000}
    local = minimise(ripples, jnp.full(2, 1.5), key=KEY, **call)
    assert (local.reason, bool(local.fun > 0.1)) == ("converged", True)
    found = minimise(ripples, jnp.full(2, 1.5), key=KEY, target=1e-3, **call)
    assert (found.reason, bool(found.fun <= 1e-3)) == ("target", True)


@pytest.mark.parametrize(
    ("bounds", "residuals", "follow"),
    [
        ((-3.0, 3.0), False, True),
        ((-3.0, jnp.inf), False, False),
        (None, False, False),
        ((-3.0, 3.0), True, True),
        ((-jnp.inf, 3.0), True, False),
    ],
)
def test_searches_follow_where_they_can_begin_anywhere(bounds, residuals, follow):
    found = [default_solver(jnp.ones(2), bounds, None, residuals, until=u) for u in (False, True)]
    assert [solver.restarts > 0 for solver in found] == [False, follow]


@pytest.mark.parametrize("residuals", [False, True])
def test_no_search_follows_one_of_batches(residuals):
    schedule = optax.linear_schedule(1.0, 0.1, 50)
    by_schedule = default_solver(jnp.ones(2), (-3.0, 3.0), schedule, residuals, until=True)
    many = default_solver(jnp.ones(100), (-3.0, 3.0), None, residuals, until=True)
    assert [getattr(solver, "restarts", 0) for solver in (by_schedule, many)] == [0, 0]


@pytest.mark.slow
def test_no_search_follows_another_of_a_function_with_noise():
    noisy = lambda y, args, key: bowl(y, args) + 0.01 * jax.random.normal(key)
    call = {"target": -1.0, "takes_key": True, "max_evaluations": 40, "bounds": (-3.0, 3.0)}
    assert minimise(noisy, jnp.ones(3), key=KEY, **call).reason == "max_evaluations"


def test_a_target_ends_the_run():
    result = sd.minimise(bowl, jnp.ones(3), key=KEY, target=0.5)
    assert (result.reason, result.result) == ("target", optx.RESULTS.successful)
    assert result.fun <= 0.5


def test_seconds_end_the_run():
    result = sd.minimise(stairs, jnp.zeros(3), key=KEY, max_seconds=0.0)
    assert result.reason == "max_seconds"
    assert result.result == optx.RESULTS.nonlinear_max_steps_reached
    assert not result.history


@pytest.mark.slow
def test_a_plateau_is_no_convergence(x64):
    result = sd.minimise(lambda y, _: 0 * jnp.sum(y), jnp.ones(3), key=KEY)
    assert result.reason in ("noise", "stalled")
    assert result.result == optx.RESULTS.stagnation
    result = sd.least_squares(lambda y, _: 0 * y + 1, jnp.ones(3), key=KEY)
    assert result.reason == "stalled"


def test_no_lower_sum_of_squares_than_zero_is_sought():
    pixels = jnp.arange(32.0)
    bar = lambda y: jnp.where(jnp.abs(pixels - y) < 4.5, 1.0, 0.0)
    result = sd.least_squares(lambda y, _: bar(y) - bar(20.0), 15.0, key=KEY, sigma=3.0)
    assert (result.fun, result.reason) == (0, "converged")
    assert result.evaluations < 30


@pytest.mark.parametrize(
    ("limit", "match"),
    [
        ({"max_evaluations": float("nan")}, "max_evaluations=nan must be a whole number"),
        ({"max_evaluations": 1.5}, "max_evaluations=1.5 must be a whole number"),
        ({"max_steps": -1}, "max_steps=-1 must be a whole number"),
        ({"max_seconds": float("nan")}, "max_seconds is NaN"),
        ({"max_seconds": -1.0}, "max_seconds=-1.0 must be 0 or more"),
        ({"target": float("nan")}, "target is NaN"),
        ({"max_evaluations": 3}, "leaves no room"),
    ],
)
def test_limits_that_are_none_are_refused(limit, match):
    with pytest.raises(ValueError, match=match):
        minimise(bowl, jnp.ones(3), key=KEY, **limit)


@pytest.mark.parametrize(("num_samples", "fewer"), [(None, False), (1, False), (4, True)])
def test_fewer_samples_are_advised_where_there_are_several(num_samples, fewer):
    solver = sd.NewtonCG(0.2, num_samples=num_samples)
    with pytest.raises(ValueError, match="leaves no room") as error:
        minimise(bowl, jnp.ones(3), key=KEY, solver=solver, max_evaluations=3)
    assert ("num_samples" in str(error.value)) == fewer


# under optimistix


@pytest.mark.slow
def test_the_host_takes_the_steps_of_optimistix(x64):
    """But for rounding: the parts of a step are compiled each by itself."""
    for solver, run, twin, fun in [
        (sd.NewtonCG(0.3), sd.minimise, optx.minimise, bowl),
        (
            sd.GaussNewton(0.3),
            sd.least_squares,
            optx.least_squares,
            lambda y, _: y**3 - jnp.array(TARGET, y.dtype),
        ),
    ]:
        result = run(fun, jnp.ones(3), key=KEY, solver=solver, max_steps=14)
        options = {"key": KEY}
        found = twin(fun, solver, jnp.ones(3), options=options, max_steps=14, throw=False)
        lowest = found.state.progress.lowest_y
        np.testing.assert_allclose(result.y, lowest, rtol=1e-6, atol=1e-9)


# compiled once


@pytest.mark.parametrize("committed", [False, True])
@pytest.mark.parametrize("solver", quick_of([sd.GaussNewton, sd.NewtonCG], [sd.NewtonCG]))
def test_another_function_or_sigma_compiles_nothing_but_the_function(solver, committed, caplog):
    traced = []
    start = jax.device_put(jnp.ones(3), jax.devices()[0] if committed else None)
    assert start.committed == committed
    jax.clear_caches()

    def run(fun, key, sigma):
        call: Any = sd.least_squares if solver is sd.GaussNewton else sd.minimise
        call(fun, start, key=key, solver=solver(sigma), max_steps=30)

    def residuals(shift):
        def fun(y, _):
            traced.append(shift)
            rows = y**3 - shift * jnp.array(TARGET)
            return rows if solver is sd.GaussNewton else jnp.sum(rows**2)

        return fun

    run(residuals(1.0), KEY, 0.3)
    before, key = len(traced), jax.random.key(1)
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        run(residuals(2.0), key, 0.2)
    compiled = [r.getMessage() for r in caplog.records if r.getMessage().startswith("Compiling")]
    assert [line.split()[1] for line in compiled] == ["jit(_rows_of)"]
    assert len(traced) <= 2 * before


@pytest.mark.slow
@pytest.mark.parametrize("space", [None, sd.Integer(-9, 9)], ids=["numbers", "whole"])
def test_a_start_on_a_chosen_device_compiles_no_step_twice(space, caplog):
    caplog.set_level(logging.WARNING)

    def parts(device):
        jax.clear_caches()
        caplog.clear()
        start = jax.device_put(jnp.ones(3, jnp.float32 if space is None else jnp.int32), device)
        fun = lambda y, _: jnp.sum((y - 2).astype(jnp.float32) ** 2)
        with jax.log_compiles():
            sd.minimise(fun, start, key=KEY, space=space, max_evaluations=40)
        messages = [record.getMessage() for record in caplog.records]
        programs = [line.split()[1] for line in messages if line.startswith("Compiling")]
        return sorted(name for name in programs if name.startswith("jit(_"))

    assert parts(jax.devices()[0]) == parts(None)


# what is told


@pytest.mark.parametrize(
    ("call", "error", "match"),
    [
        (lambda: minimise(lambda y: y, 1.0, key=KEY), TypeError, "write lambda y, args: fun"),
        (
            lambda: minimise(bowl, sd.NewtonCG(1.0), jnp.ones(3), key=KEY),
            TypeError,
            "by keyword",
        ),
        (
            lambda: minimise(bowl, optx.BFGS(1e-3, 1e-3), jnp.ones(3), key=KEY),
            TypeError,
            "by keyword",
        ),
        (lambda: minimise(3.0, jnp.ones(3), key=KEY), TypeError, "fun must be a function"),
        (
            lambda: minimise(lambda y, _: np.sum(np.asarray(y)), jnp.ones(3), key=KEY),
            TypeError,
            "sd.black_box",
        ),
        (
            lambda: least_squares(lambda y, _: np.sin(float(y[0])), jnp.ones(3), key=KEY),
            TypeError,
            "sd.black_box",
        ),
        (
            lambda: minimise(bowl, jnp.ones(3), key=KEY, bounds=[(0, 1), (0, 1), (0, 1)]),
            ValueError,
            "as in SciPy",
        ),
        (
            lambda: minimise(bowl, jnp.ones(3), key=KEY, sigma=[0.1, 0.1, 0.1]),
            ValueError,
            "a list is a pytree: use np.array",
        ),
        (
            lambda: least_squares(valley, jnp.ones(2), key=KEY, solver=sd.NewtonCG(0.1)),
            TypeError,
            "sd.minimise",
        ),
        (
            lambda: minimise(bowl, jnp.ones(3), key=KEY, solver=sd.NewtonCG(1.0), sigma=0.1),
            ValueError,
            r"give it to yours, NewtonCG\(",
        ),
    ],
)
def test_wrong_arguments_are_told_what_to_write(call, error, match):
    with pytest.raises(error, match=match):
        call()


# black boxes of which it is not known what they return


class Seen:
    """A host function that keeps its points."""

    def __init__(self, value):
        self.value, self.points = value, []

    def __call__(self, y):
        self.points.append(tuple(np.asarray(y).tolist()))
        return self.value(np.asarray(y))


RUNS = {
    "one number": (sd.minimise, lambda y: np.float32(np.sum((y - 0.5) ** 2)), {}),
    "residuals": (sd.least_squares, lambda y: (y**3 - 0.1).astype(np.float32), {}),
    "residuals in a space": (
        sd.least_squares,
        lambda y: (y**3 - 0.1).astype(np.float32),
        {"space": sd.Range(-2.0, 2.0)},
    ),
}


@pytest.mark.parametrize("name", quick_of(RUNS, ["residuals in a space"]))
def test_the_evaluation_that_tells_what_a_box_returns_is_the_first_of_the_run(name):
    call, value, where = RUNS[name]
    y0, found = jnp.array([1.0, -1.5]), []
    for out in (None, jax.eval_shape(lambda: jnp.asarray(value(np.ones(2, np.float32))))):
        host = Seen(value)
        box = sd.black_box(host, out=out)
        result = call(lambda y, _: box(y), y0, key=KEY, max_evaluations=30, **where)  # noqa: B023
        assert result.evaluations == len(host.points)
        assert host.points[0] == tuple(y0.tolist()) != host.points[1]
        found.append((host.points, result.fun, result.y))
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
@pytest.mark.parametrize(
    "more", [{"solver": sd.NewtonCG(0.5, num_samples=3)}, {"takes_key": True}], ids=str
)
def test_a_batch_and_other_random_numbers_are_evaluated_at_the_start_as_well(more):
    host = Seen(lambda y: np.float32(np.sum(y**2)))
    box = sd.black_box(host)
    fun = lambda y, args, key=None: box(y)
    result = sd.minimise(fun, jnp.ones(2), key=KEY, max_evaluations=20, **more)
    assert result.evaluations == len(host.points)
    assert host.points.count((1.0, 1.0)) >= 2


def test_the_evaluation_that_tells_counts_where_no_step_follows():
    host = Seen(lambda y: np.float32(np.sum(y**2)))
    box = sd.black_box(host)
    result = sd.minimise(lambda y, _: box(y), jnp.ones(2), key=KEY, max_steps=0)
    assert result.evaluations == len(host.points)


def test_what_a_run_leaves_is_jax_s():
    """Scalars of its state are NumPy's while it runs."""

    def interrupt(record):
        raise KeyboardInterrupt

    result = sd.minimise(lambda y, _: y**2, jnp.asarray(1.0), key=KEY, callback=interrupt)
    assert result.reason == "interrupted"
    arrays = [leaf for leaf in jax.tree.leaves((result.y, result.state)) if hasattr(leaf, "dtype")]
    assert all(isinstance(array, jax.Array) for array in arrays)


def test_a_first_value_that_is_not_finite_is_known_as_well():
    host = Seen(lambda y: np.float32(np.nan if y[0] == 1 else np.sum(y**2)))
    box = sd.black_box(host, on_nonfinite="nan")
    solver = sd.NewtonCG(0.5, nonfinite="drop")
    fun = lambda y, _: box(y)
    result = sd.minimise(fun, jnp.ones(2), key=KEY, solver=solver, max_evaluations=30)
    assert result.evaluations == len(host.points)
    assert host.points[0] != host.points[1]
    assert result.fun < 1


@pytest.mark.slow
def test_a_run_that_is_taken_up_goes_on_with_what_it_paid_for(tmp_path):
    host = Seen(lambda y: (y**3 - 0.1).astype(np.float32))
    options = {"key": KEY, "checkpoint": tmp_path / "run"}
    for most in (10, 14):  # each time a new box: what it returns has to be told
        box = sd.black_box(host)
        host.points.clear()
        result = sd.least_squares(
            lambda y, _: box(y),  # noqa: B023
            jnp.array([1.0, -1.5]),
            max_evaluations=most,
            **options,
        )
    assert 10 < result.evaluations <= 14
    assert len(host.points) < 10


def test_a_whole_number_and_a_slope_that_go_together():
    """Alone the number raises the loss, and nearer it changes nothing: they step as one."""
    times = jnp.linspace(0.0, 1.0, 20)

    def residuals(y, seen):
        return y["a"] * times + y["k"].astype(float) * times**2 - seen

    space = {"a": sd.Range(0.0, 10.0), "k": sd.Integer(0, 8)}
    for seed in range(4):
        noise = 0.05 * jax.random.normal(jax.random.key(seed), times.shape)
        seen = 2 * times + 3 * times**2 + noise
        found = sd.least_squares(
            residuals, {"a": 1.0, "k": 6}, seen, key=jax.random.key(seed), space=space
        )
        assert int(found.y["k"]) == 3
