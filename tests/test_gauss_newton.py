"""Gauss-Newton on residuals: known optima, bounds, plateaus, faults, optimistix's solvers."""

import itertools
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import smoothdiff as sd

KEY = jax.random.key(3)
DESIGN = np.random.default_rng(0).normal(size=(6, 3))
DATA = np.random.default_rng(1).normal(size=6)
TIMES = np.linspace(0, 1, 20)
PIXELS = np.arange(32)


def line(y, args):
    """Linear, and not zero anywhere."""
    return jnp.asarray(DESIGN, y.dtype) @ y - jnp.asarray(DATA, y.dtype)


def decay(y, noise):
    t = jnp.asarray(TIMES, y.dtype)
    data = 2 * jnp.exp(-3 * t) + 0.5 + noise
    return y[0] * jnp.exp(-y[1] * t) + y[2] - data


def bars(y, target):
    """Two bars of seven pixels; the middle of each plateau is at a whole number."""
    draw = lambda y: (jnp.abs(jnp.asarray(PIXELS, y.dtype)[None] - y[:, None]) <= 3.5).astype(
        y.dtype
    )
    return draw(y) - draw(target)


def tree(y, args):
    return {"first": y["a"] - 1, "second": [y["b"] * y["a"] - jnp.full((2,), 3, y["b"].dtype)]}


def seen_by(fun, seen):
    """The same function, and where it was evaluated."""

    def fun_(y, args):
        jax.debug.callback(lambda y: seen.append(np.array(y)), y, ordered=True)
        return fun(y, args)

    return fun_


def solve(fun, y0, args=None, sigma: Any = 0.3, evaluations=200, bounds=None, **options):
    solver = sd.GaussNewton(sigma, **options)
    return sd.least_squares(
        fun, y0, args, key=KEY, solver=solver, max_evaluations=evaluations, bounds=bounds
    )


def test_a_linear_problem_is_solved_though_its_residuals_never_vanish(dtype):
    result = solve(line, jnp.zeros(3, dtype), sigma=1.0)
    best = np.linalg.lstsq(DESIGN, DATA)[0]
    assert result.y.dtype == dtype
    # the sum of squares is flat to the root of the rounding error
    np.testing.assert_allclose(result.y, best, atol=float(jnp.finfo(dtype).eps) ** 0.5)
    assert result.fun == pytest.approx(np.sum((DESIGN @ best - DATA) ** 2) / 2, rel=1e-3)


def test_a_curve_without_noise_is_fitted_to_rounding(dtype):
    noise = jnp.zeros(20, dtype)
    result = solve(decay, jnp.ones(3, dtype), noise, evaluations=300)
    np.testing.assert_allclose(result.y, [2, 3, 0.5], atol=2e3 * float(jnp.finfo(dtype).eps))


def test_a_curve_with_noise_goes_to_the_least_squares_solution(x64):
    noise = 0.1 * jnp.asarray(np.random.default_rng(2).normal(size=20))
    exact = optx.least_squares(decay, optx.LevenbergMarquardt(1e-10, 1e-10), jnp.ones(3), noise)
    result = solve(decay, jnp.ones(3), noise, evaluations=400)
    # 20 times closer than the truth is, which a standard error of the noise separates from it
    distance = np.linalg.norm(exact.value - np.array([2, 3, 0.5]))
    assert np.linalg.norm(result.y - exact.value) < distance / 20


@pytest.mark.parametrize("bound", [(-0.1, 0.1), (-5.0, 0.3)])
def test_bounds_give_the_constrained_solution(bound, x64):
    from scipy.optimize import lsq_linear

    seen = []

    def watched(y, args):
        jax.debug.callback(lambda y: seen.append(np.asarray(y)), y)
        return line(y, args)

    result = solve(watched, jnp.zeros(3), sigma=0.1, bounds=bound)
    jax.effects_barrier()
    np.testing.assert_allclose(result.y, lsq_linear(DESIGN, DATA, bound).x, atol=1e-6)
    assert seen
    assert all(np.all((bound[0] <= y) & (y <= bound[1])) for y in seen)


def test_plateaus_lead_to_their_middle(dtype):
    y0, target = jnp.array([8.0, 25.0], dtype), jnp.array([14.0, 20.0], dtype)
    result = solve(bars, y0, target, sigma=3.0)
    assert jnp.all(bars(result.y, target) == 0)
    np.testing.assert_allclose(result.y, target, atol=0.1)


def test_one_plateau_everywhere_widens_sigma():
    flat = lambda y, args: jnp.stack([jnp.where(jnp.abs(y) < 50, 1.0, 0.0), 0.0])
    result = solve(flat, jnp.array(0.0), sigma=1.0, evaluations=60)
    widths = [record.sigma for record in result.history]
    assert widths[:4] == pytest.approx([1, 2, 4, 8])


@pytest.mark.parametrize("restarts", [0, 9])
def test_iterates_are_those_of_optimistix_to_the_last_bit(dtype, restarts):
    y0, target, bounds = jnp.array([2, 29], dtype), jnp.array([14, 20], dtype), (0.0, 31.0)
    solver = sd.GaussNewton(3.0, patience=2, restarts=restarts)
    options = {"key": KEY, "bounds": bounds}
    steps = 25 if restarts else 8
    solution = optx.least_squares(bars, solver, y0, target, options, max_steps=steps, throw=False)
    run = partial(sd.least_squares, bars, y0, target, key=KEY, solver=solver, bounds=bounds)
    result = run(max_steps=steps)
    np.testing.assert_array_equal(result.y, solution.value)
    for name in ("fun", "stderr", "evaluations"):
        assert getattr(result, name) == solution.stats[name]
    begun = 1 + sum(np.array_equal(record.y, y0) for record in result.history[:-1])
    assert (begun > 1) == bool(restarts)
    # a first batch of six for each search, steps of two but where all are the same, and the two
    # candidates judged
    at_least = 6 * begun + 2 * (steps - begun) + 2 * 6
    assert result.evaluations == at_least if not restarts else result.evaluations >= at_least


def test_runs_inside_jit_over_pytrees():
    solver = sd.GaussNewton({"a": 0.2, "b": 0.5})

    @jax.jit
    def run(key, y0):
        options = {"key": key}
        return optx.least_squares(
            tree, solver, y0, options=options, max_steps=25, throw=False
        ).value

    y0 = {"a": jnp.array(0.3), "b": jnp.zeros(2)}
    y = run(KEY, y0)
    assert jax.tree.structure(y) == jax.tree.structure(y0)
    np.testing.assert_allclose(y["a"], 1, atol=1e-3)
    np.testing.assert_allclose(y["b"], 3, atol=3e-3)


def test_many_parameters_need_no_square_matrix_of_them():
    n = 5_000
    fun = lambda y, args: jnp.stack([jnp.sum(y[::2]), jnp.sum(y[1::2])]) / n**0.5 - 1
    result = solve(fun, jnp.zeros(n), sigma=0.1, evaluations=300, num_samples=16)
    assert result.fun < 0.5 * result.history[0].fun


@pytest.mark.parametrize("parameters", [3, 40])
def test_an_unknown_linear_map_is_learnt(parameters):
    """Fewer or more parameters than evaluations in the history, and a side that is closed."""
    matrix = np.random.default_rng(2).normal(size=(parameters, parameters)) / parameters**0.5
    sought = np.linspace(0.1, 0.9, parameters)
    result = sd.least_squares(
        lambda y, args: jnp.asarray(matrix, y.dtype) @ (y - jnp.asarray(sought, y.dtype)),
        jnp.full(parameters, 0.5),
        key=KEY,
        solver=sd.GaussNewton(0.5, num_samples=12, history=36),
        max_evaluations=60 * parameters,
        bounds=(0.0, None),
    )
    start = np.sum((matrix @ (0.5 - sought)) ** 2) / 2
    assert result.fun < 0.02 * start


@pytest.mark.parametrize("bounds", [None, (-4.0, 4.0)])
def test_which_residuals_a_parameter_moves_is_found(bounds):
    """Each residual has two parameters of its own; 4,200 others do nothing."""
    n, size = 5_000, 400
    sought = jnp.asarray(np.random.default_rng(0).normal(size=size), jnp.float32)
    fun = lambda y, args: y[:size] + 0.3 * y[size : 2 * size] - sought
    result = solve(fun, jnp.zeros(n), sigma=0.5, evaluations=6 * 96, bounds=bounds)
    assert float(jnp.sum(fun(result.y, None) ** 2)) < 0.01 * float(jnp.sum(sought**2))


def test_a_few_directions_of_many_parameters_are_enough():
    """No residual has parameters of its own, but all depend on few combinations of them."""
    n, rank = 5_000, 10
    rng = np.random.default_rng(1)
    mix = jnp.asarray(rng.normal(size=(rank, n)) / n**0.5, jnp.float32)
    show = jnp.asarray(rng.normal(size=(60, rank)), jnp.float32)
    fun = lambda y, args: show @ (mix @ y - 1)
    result = solve(fun, jnp.zeros(n), sigma=1.0, evaluations=4 * 96)
    start = float(jnp.sum(fun(jnp.zeros(n), None) ** 2))
    assert float(jnp.sum(fun(result.y, None) ** 2)) < 1e-3 * start


def test_steps_that_make_it_worse_are_not_taken():
    """A narrow valley, and noise in no direction: the sum of squares never rises."""
    n = 200
    fun = lambda y, args: jnp.concatenate([10 * (y[1:] - y[:-1] ** 2), 1 - y[:-1]])
    result = solve(fun, jnp.full(n, -0.5), sigma=0.1, evaluations=10 * 96)
    squares = [float(jnp.sum(fun(record.y, None) ** 2)) for record in result.history]
    assert all(after <= before for before, after in itertools.pairwise(squares))
    assert squares[-1] < 0.5 * squares[0]


def test_defaults_grow_with_the_parameters():
    few, many, very_many = (
        sd.GaussNewton(1.0).evaluations_per_step(jnp.zeros(n)) for n in (2, 100, 10**5)
    )
    assert (few, many, very_many) == (6, 50, 96)


@pytest.mark.parametrize(("parameters", "first", "later"), [(3, 7, 3), (120, 60, 60)])
def test_what_is_reported_was_evaluated(parameters, first, later):
    """Fewer once samples differ; and with many parameters those of the steps that are tried."""
    seen = []
    bowl = seen_by(lambda y, args: y - 1, seen)
    result = solve(bowl, jnp.zeros(parameters), evaluations=3 * first)
    jax.effects_barrier()
    assert len(seen) == result.evaluations
    took = np.diff([0, *(record.evaluations for record in result.history)])
    assert took[0] == first
    assert set(took[1:].tolist()) <= {later}


def test_a_plateau_is_looked_at_with_all_samples():
    result = solve(lambda y, args: jnp.ones(5), jnp.zeros(3), evaluations=40)
    assert [record.evaluations for record in result.history] == [7, 14, 21]


def test_a_step_is_tried_five_times_as_far_and_a_better_point_is_gone_on_from():
    seen, step = [], lambda y, args: 100 - y + 5 * jnp.sin(y)[None] * jnp.ones(2)
    run = sd.least_squares(
        seen_by(step, seen), jnp.array(0.0), key=KEY, solver=sd.GaussNewton(1.0), max_steps=6
    )
    jax.effects_barrier()
    ys = [0.0, *(float(record.y) for record in run.history)]
    ends = [0, *(record.evaluations for record in run.history)]
    further, gone_on = 0, 0
    for i in range(1, len(run.history)):
        batch = np.array(seen[ends[i] : ends[i + 1]])
        assert batch[0] == ys[i]
        if 5 * abs(ys[i] - ys[i - 1]) >= run.history[i].sigma:
            further += 1
            assert batch[1] == pytest.approx(ys[i] + 5 * (ys[i] - ys[i - 1]), rel=1e-5)
            # it is no sample of the smoothed function, so that only the iterate tells of that
            alone = np.sum(np.square(step(ys[i], None))) / 2
            assert run.history[i].fun == pytest.approx(float(alone), rel=1e-5)
            assert np.isnan(run.history[i].stderr)
        # the next step is from the best point so far, if that is clearly better than the iterate
        values = [float(np.sum(np.square(step(y, None)))) for y in seen[: ends[i + 1]]]
        better = min(values) < 0.8 * float(np.sum(np.square(step(ys[i], None))))
        best = float(seen[int(np.argmin(values))]) if better else ys[i]
        gone_on += better
        assert abs(ys[i + 1] - best) <= 2.0 * run.history[i].sigma * (1 + 1e-5)
    assert further >= 3
    assert gone_on >= 2


@pytest.mark.parametrize("beyond", [np.nan, np.inf, 1e22])
def test_what_is_tried_further_on_may_be_anything(beyond):
    seen, wall = [], lambda y, args: jnp.where(y > 30, beyond, jnp.stack([20 - y, 1.0]))
    result = solve(seen_by(wall, seen), jnp.array(0.0), sigma=0.5, evaluations=60)
    jax.effects_barrier()
    assert max(seen) > 30
    assert result.reason == "max_evaluations"
    np.testing.assert_allclose(result.y, 20, atol=0.05)


def test_an_iterate_that_is_dropped_is_no_perfect_one():
    hole = lambda y, args: jnp.where(jnp.abs(y - 1) < 0.1, jnp.nan, jnp.stack([20 - y, 1.0]))
    result = solve(hole, jnp.array(0.0), sigma=0.5, evaluations=60, nonfinite="drop")
    # the longest step of all leads into the hole, and the best point of the history out of it
    assert result.history[0].y == pytest.approx(1.0)
    assert result.history[1].y > 1.5
    np.testing.assert_allclose(result.y, 20, atol=0.05)


def test_a_schedule_is_taken_as_it_is():
    schedule = lambda step: 0.5 / (step + 1)
    solver = sd.GaussNewton(schedule)
    result = sd.least_squares(line, jnp.zeros(3), key=KEY, solver=solver, max_steps=4)
    assert [r.sigma for r in result.history] == pytest.approx([0.5, 0.25, 0.5 / 3, 0.125])


def test_converges_by_tolerance():
    solver = sd.GaussNewton(0.3, rtol=1e-2, atol=1e-2)
    noise = jnp.zeros(20)
    result = sd.least_squares(decay, jnp.ones(3), noise, key=KEY, solver=solver)
    assert result.reason == "converged"
    np.testing.assert_allclose(result.y, [2, 3, 0.5], atol=0.02)


def places(y, target):
    """A short and a long bar in one picture; where they have changed places, all ways lead up."""
    pixels = jnp.asarray(np.arange(40), y.dtype)
    bar = lambda y, size: (jnp.abs(pixels - y) <= size).astype(y.dtype)
    draw = lambda y: bar(y[0], 1.5) + bar(y[1], 4.5)
    return draw(y) - draw(target)


def test_restarts_find_the_deepest_of_several_valleys():
    # the bars begin where they have all but changed places
    y0, target, bounds = jnp.array([28.0, 11.0]), jnp.array([10.0, 29.0]), (0.0, 39.0)
    once, often = sd.GaussNewton(3.0), sd.GaussNewton(3.0, restarts=20)
    found = []
    for key in jax.random.split(KEY, 6):
        run = partial(sd.least_squares, places, y0, target, key=key, bounds=bounds)
        one, all_of_them = run(solver=once, max_steps=60), run(solver=often, max_steps=600)
        found.append([np.allclose(result.y, target, atol=1) for result in (one, all_of_them)])
        # nothing is different until the first search leads nowhere
        for a, b in zip(one.history[:30], all_of_them.history, strict=False):
            np.testing.assert_array_equal(a.y, b.y)
    by_one, by_all = np.sum(found, axis=0)
    assert by_one < 4
    assert by_all > 4


def test_a_restart_begins_at_the_start_with_the_first_sigma():
    solver = sd.GaussNewton(0.5, patience=3, restarts=2)
    run = sd.least_squares(line, jnp.ones(3), key=KEY, solver=solver, max_steps=100)
    begun = [i for i, r in enumerate(run.history) if np.array_equal(r.y, np.ones(3))]
    assert len(begun) == 2
    # the last search goes on, as the only one would
    assert run.reason == "max_steps"
    for i in begun:
        assert run.history[i + 1].sigma == 0.5
        assert not np.array_equal(run.history[i + 1].y, run.history[0].y)
    np.testing.assert_allclose(run.y, np.linalg.lstsq(DESIGN, DATA)[0], atol=1e-2)


def test_a_run_resumed_in_a_later_search_ends_with_the_same_bits(tmp_path):
    path, solver = tmp_path / "run.npz", sd.GaussNewton(0.5, patience=2, restarts=5)
    run = partial(sd.least_squares, line, jnp.ones(3), key=KEY, solver=solver)
    whole = run(max_steps=40)
    begun = [i for i, r in enumerate(whole.history, 1) if np.array_equal(r.y, np.ones(3))]
    between = begun[0] + 2
    assert between < begun[1] < 40
    run(max_steps=between, checkpoint=path)
    resumed = run(max_steps=40, checkpoint=path)
    np.testing.assert_array_equal(resumed.y, whole.y)
    for name in ("step", "evaluations", "fun", "stderr", "sigma", "y"):
        one, other = ([getattr(r, name) for r in result.history] for result in (resumed, whole))
        np.testing.assert_array_equal(one, other)
    assert (resumed.fun, resumed.evaluations) == (whole.fun, whole.evaluations)


def test_a_search_that_converged_is_followed_by_the_next():
    noise = jnp.zeros(20)
    run = partial(sd.least_squares, decay, jnp.ones(3), noise, key=KEY)
    once = run(solver=sd.GaussNewton(0.3, rtol=1e-2, atol=1e-2))
    twice = run(solver=sd.GaussNewton(0.3, rtol=1e-2, atol=1e-2, restarts=1))
    assert once.reason == twice.reason == "converged"
    assert len(twice.history) > len(once.history)
    np.testing.assert_allclose(twice.y, [2, 3, 0.5], atol=0.02)


def test_many_parameters_restart():
    sought = jnp.asarray(np.random.default_rng(0).normal(size=120), jnp.float32)
    solver = sd.GaussNewton(0.5, patience=2, restarts=2)
    run = sd.least_squares(
        lambda y, args: jnp.round(4 * (y - sought)), jnp.zeros(120), key=KEY, solver=solver,
        max_steps=40,
    )  # fmt: skip
    assert sum(np.array_equal(record.y, np.zeros(120)) for record in run.history) >= 2
    assert run.fun < 0.1 * run.history[0].fun


def test_nan_during_a_step_keeps_what_was_found():
    broken = lambda y, args: jnp.where(y[0] > 0.7, jnp.nan, 1.0) * (y - 1)
    with pytest.raises(sd.MinimiseError, match="NaN or infinite") as caught:
        solve(broken, jnp.zeros(2), sigma=0.1)
    result = caught.value.result
    assert result.reason == "nonfinite"
    assert np.all(np.isfinite(result.y))
    assert result.history


def test_bad_samples_are_left_out():
    broken = lambda y, args: jnp.where(y[0] > 1.05, jnp.nan, 1.0) * (y - 1)
    result = solve(broken, jnp.full(2, 0.5), sigma=0.1, nonfinite="drop")
    np.testing.assert_allclose(result.y, 1, atol=1e-3)


@pytest.mark.parametrize(
    "make",
    [
        lambda: sd.GaussNewton(0.1, num_samples=2),
        lambda: sd.GaussNewton(0.1, num_samples=8, history=4),
        lambda: sd.GaussNewton(0.1, restarts=-1),
        lambda: sd.GaussNewton(0.1, patience=0),
        lambda: solve(line, jnp.zeros(3), sigma=-1.0),
        lambda: solve(tree, {"a": jnp.ones(()), "b": jnp.ones(2)}, sigma={"a": 1.0, "b": None}),
    ],
)
def test_bad_settings_are_refused(make):
    with pytest.raises(ValueError, match=r"num_samples|history|restarts|patience|sigma"):
        make()


def test_wrong_kinds_are_refused():
    integers = lambda y, args: jnp.round(y).astype(int)
    with pytest.raises(TypeError, match="astype"):
        solve(integers, jnp.zeros(2))
    solver: Any = sd.GaussNewton(0.1)
    with pytest.raises(TypeError, match="solver"):
        sd.minimise(line, jnp.zeros(3), key=KEY, solver=solver)
    solver = optx.LevenbergMarquardt(1e-3, 1e-3)
    with pytest.raises(TypeError, match="smoothdiff's"):
        sd.least_squares(line, jnp.zeros(3), key=KEY, solver=solver)


@pytest.mark.parametrize(
    "solver",
    [optx.LevenbergMarquardt(1e-4, 1e-4), optx.BFGS(1e-4, 1e-4), optx.NonlinearCG(1e-4, 1e-4)],
    ids=lambda solver: type(solver).__name__,
)
def test_solvers_of_optimistix_run_on_a_smoothed_function(solver):
    target = jnp.array([14.0, 20.0])
    residuals = sd.smooth(lambda y: bars(y, target), 3.0, num_samples=64, baseline="mean")
    fixed = lambda y, args: residuals(KEY, y)
    y0 = jnp.array([12.0, 21.5])
    before = jnp.sum(fixed(y0, None) ** 2)
    solution = optx.least_squares(fixed, solver, y0, max_steps=40, throw=False)
    assert jnp.sum(fixed(solution.value, None) ** 2) < before
    np.testing.assert_allclose(solution.value, target, atol=1.0)
