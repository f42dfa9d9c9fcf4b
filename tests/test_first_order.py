"""FirstOrder under optimistix: what it converges to, what it accepts, and what it refuses."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest

import smoothdiff as sd
from smoothdiff._solvers._base import Progress, judge, project

KEY = jax.random.key(2)
TARGET = jnp.array([0.6, -0.4])
SUCCESS, MAX_STEPS, NONFINITE = (
    optx.RESULTS.successful,
    optx.RESULTS.nonlinear_max_steps_reached,
    optx.RESULTS.nonfinite,
)


def plateaus(y, target):
    return jnp.sum(jnp.floor(8 * jnp.abs(y - target)))


def bowl(y, target):
    return jnp.sum((y - target) ** 2)


def run(fun, solver, y0, args=None, *, bounds=None, steps=200, key=KEY, **rest):
    options = {"key": key} if bounds is None else {"key": key, "bounds": bounds}
    return optx.minimise(fun, solver, y0, args, options, max_steps=steps, throw=False, **rest)


# what it finds


def test_crosses_plateaus_in_both_precisions(dtype):
    solver = sd.FirstOrder(optax.adam(0.05), optax.linear_schedule(0.3, 0.05, 200))
    solution = run(plateaus, solver, jnp.zeros(2, dtype), TARGET.astype(dtype))
    assert solution.value.dtype == solution.stats["fun"].dtype == dtype
    # the lowest plateau is the square of half-width 1/8 around the target
    np.testing.assert_allclose(solution.value, TARGET, atol=0.06)
    assert solution.result == MAX_STEPS
    assert solution.stats["evaluations"] == 200 * 8 + 3 * 8


def test_gradient_descent_follows_the_smoothed_gradient():
    """On a bowl the smoothed gradient is the gradient: sgd contracts by 1 - 2 lr a step."""
    solver = sd.FirstOrder(optax.sgd(0.1), 0.01, num_samples=4096)
    state = run(bowl, solver, jnp.ones(2), jnp.zeros(2), steps=5).state
    # the batch of the fifth step was at the fourth iterate; of the iterate, each step adds an error
    # of 0.2 sqrt(3 / pairs) = 0.008, and of its square, after four, 0.03
    assert state.progress.fun == pytest.approx(2 * 0.8**8, rel=0.1)


def test_pytrees_with_a_sigma_for_each_leaf_and_ad_where_there_is_none():
    def fun(y, args):
        rounded = jnp.round(jax.lax.stop_gradient(8 * y["rough"])) / 8
        return jnp.sum((rounded - 0.5) ** 2) + jnp.sum((y["smooth"][0] - 2.0) ** 2)

    y0 = {"rough": jnp.zeros(2), "smooth": [jnp.zeros(())]}
    solver = sd.FirstOrder(optax.adam(0.1), {"rough": 0.1, "smooth": [None]}, batch_size=4)
    solution = run(fun, solver, y0)
    np.testing.assert_allclose(solution.value["rough"], 0.5, atol=0.1)
    np.testing.assert_allclose(solution.value["smooth"][0], 2.0, atol=1e-2)
    assert solution.state.progress.sigma == jnp.float32(0.1)


def test_bounds_hold_for_the_iterates_and_for_what_the_function_sees():
    seen = []
    host = lambda y: seen.append(np.array(y)) or np.sum((y - [2.0, -0.4, 0.0]) ** 2)
    box = sd.black_box(host, jax.ShapeDtypeStruct((), jnp.float32))
    fun = lambda y, args: box(jnp.append(y["a"], y["b"])) + (y["c"] - 3) ** 2
    y0 = {"a": jnp.zeros(2), "b": jnp.zeros(()), "c": jnp.zeros(())}
    low, high = {"a": jnp.array([-1.0, 0.1]), "b": None, "c": None}, {"a": 1.0, "b": 0.5, "c": 2.5}
    y0["a"] = jnp.array([0.0, 0.5])
    solver = sd.FirstOrder(optax.adam(0.1), {"a": 0.1, "b": 0.2, "c": None})
    records = []
    result = sd.minimise(
        fun, y0, key=KEY, solver=solver, max_steps=60, bounds=(low, high), callback=records.append
    )
    # pulled towards (2, -0.4) and 3, across the bounds (1, 0.1) and 2.5
    np.testing.assert_allclose(result.y["a"], [1.0, 0.1], atol=0.05)
    np.testing.assert_allclose(result.y["c"], 2.5, atol=0.01)
    points = np.stack(seen)
    assert len(points) == result.evaluations
    assert np.all(points[:, 0] <= 1)
    assert np.all(points[:, 1] >= np.float32(0.1))
    assert np.all(points[:, 2] <= 0.5)
    assert points[:, 2].min() < -0.1
    for y in [r.y for r in records]:
        assert y["a"][0] <= 1
        assert y["a"][1] >= np.float32(0.1)
        assert y["c"] <= 2.5


def test_the_average_wins_where_noise_makes_the_iterates_wander():
    def noisy(y, key):
        bits = jax.lax.bitcast_convert_type(y, jnp.uint32)
        return y**2 + jax.random.normal(jax.random.fold_in(key, bits))

    solver = sd.FirstOrder(optax.sgd(0.2), 0.5, num_samples=16)
    seeds = jnp.arange(64)

    def final(seed):
        key = jax.random.key(seed)
        solution = run(noisy, solver, 0.0, key, key=jax.random.key(500 + seed))
        return solution.value, solution.state.average

    value, average = jax.jit(jax.vmap(final))(seeds)
    # sgd with step a on y^2 and gradient noise s^2 = (1 + ...) / (16 * 0.5^2) wanders with variance
    # a s^2 / (4 (1 - a)), of which the average over ten steps keeps about a third
    wander = 0.2 * (1 / (16 * 0.25)) / (4 * 0.8)
    assert np.mean(average**2) < 0.6 * wander
    assert np.mean(value**2) < 0.9 * wander


# how it runs


def test_vmap_over_keys_and_starts_is_a_loop_over_them():
    solver = sd.FirstOrder(optax.adam(0.05), 0.2)
    one = lambda key, y0: run(plateaus, solver, y0, TARGET, steps=20, key=key).value
    keys, starts = jax.random.split(KEY, 3), jnp.array([[0.0, 0.0], [1.0, 1.0], [-1.0, 0.5]])
    many = jax.jit(jax.vmap(one))(keys, starts)
    for key, y0, value in zip(keys, starts, many, strict=True):
        np.testing.assert_allclose(value, one(key, y0), rtol=1e-5, atol=1e-6)


def test_the_state_is_arrays_and_keeps_its_form():
    solver = sd.FirstOrder(optax.adam(0.05), optax.linear_schedule(0.3, 0.05, 9), num_samples=4)
    fn, options = lambda y, args: (bowl(y, args), None), {"key": KEY}
    y0, scalar = jnp.zeros(2), jax.ShapeDtypeStruct((), jnp.float32)
    state = solver.init(fn, y0, TARGET, options, scalar, None, frozenset())
    step = jax.jit(lambda state: solver.step(fn, y0, TARGET, options, state, frozenset()))
    y, after, _ = step(state)
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(state))
    assert eqx.tree_equal(*jax.eval_shape(lambda: (state, after)))
    assert (after.progress.step, after.progress.evaluations) == (1, 4)
    assert after.progress.sigma == jnp.float32(0.3)
    np.testing.assert_array_equal(after.progress.best_y, y0)
    np.testing.assert_array_equal(after.average, y)


def test_transformations_that_ask_for_the_value_get_it():
    plateau = optax.contrib.reduce_on_plateau(factor=0.5, patience=2, accumulation_size=1)
    solver = sd.FirstOrder(optax.chain(optax.sgd(0.05), plateau), 0.01)
    solution = run(bowl, solver, jnp.zeros(2), TARGET, steps=80)
    np.testing.assert_allclose(solution.value, TARGET, atol=0.01)
    assert optax.tree.get(solution.state.opt_state, "scale") < 1


def test_aux_is_that_of_a_sample():
    fun = lambda y, args: (bowl(y, args), {"y": y})
    solver = sd.FirstOrder(optax.sgd(0.1), 0.01)
    solution = run(fun, solver, jnp.zeros(2), TARGET, has_aux=True)
    np.testing.assert_allclose(solution.aux["y"], TARGET, atol=0.05)


@pytest.mark.parametrize(("num_samples", "baseline"), [(2, "mean"), (3, "center")])
def test_a_single_pair_has_a_gradient_but_no_standard_error(num_samples, baseline):
    solver = sd.FirstOrder(optax.adam(0.02), 0.2, num_samples=num_samples, baseline=baseline)
    solution = run(plateaus, solver, jnp.zeros(2), TARGET, steps=400)
    np.testing.assert_allclose(solution.value, TARGET, atol=0.1)
    assert np.isnan(solution.stats["stderr"])
    assert np.isfinite(solution.stats["fun"])


def test_drop_leaves_failed_samples_out():
    fun = lambda y, args: jnp.where(jnp.cos(50 * y[0]) > 0.8, jnp.nan, bowl(y, TARGET))
    drop = sd.FirstOrder(optax.adam(0.05), 0.1, num_samples=32, nonfinite="drop")
    solution = run(fun, drop, jnp.zeros(2), steps=100)
    assert solution.result == MAX_STEPS
    np.testing.assert_allclose(solution.value, TARGET, atol=0.1)
    propagate = sd.FirstOrder(optax.adam(0.05), 0.1, num_samples=32)
    assert run(fun, propagate, jnp.zeros(2), steps=100).result == NONFINITE


# when it stops


def test_converges_at_tolerance_and_otherwise_uses_its_budget():
    decaying = optax.sgd(optax.exponential_decay(0.3, 1, 0.7))
    solver = sd.FirstOrder(decaying, 0.01, atol=1e-4)
    solution = run(bowl, solver, jnp.zeros(2), TARGET)
    assert solution.result == SUCCESS
    assert 5 < solution.stats["num_steps"] < 60
    # without one not even a plateau, where every update is zero, is a reason to stop
    flat = run(lambda y, args: jnp.zeros(()), sd.FirstOrder(optax.sgd(0.1), 0.1), 1.0, steps=20)
    assert flat.result == MAX_STEPS


def test_a_failed_step_keeps_the_iterate_and_says_so():
    """The first update leads out of the domain of the function, where the second fails."""
    fun = lambda y, args: jnp.where(jnp.abs(y[0]) > 10, jnp.nan, bowl(y, TARGET))
    solution = run(fun, sd.FirstOrder(optax.sgd(30.0), 0.1), jnp.ones(2))
    assert solution.result == NONFINITE
    assert solution.stats["num_steps"] == 2
    # the start is the only candidate with a finite estimate
    np.testing.assert_array_equal(solution.value, jnp.ones(2))
    assert solution.stats["fun"] == pytest.approx(0.4**2 + 1.4**2, rel=0.5)


# bad input


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({}, ValueError, r"options=\{\"key\": jax\.random\.key\(0\)\}"),
        ({"key": 0}, TypeError, r"jax\.random\.key\(0\)"),
        ({"key": KEY, "bound": (0, 1)}, ValueError, '"key" and "bounds"'),
    ],
)
def test_bad_options_are_refused(options, error, match):
    solver = sd.FirstOrder(optax.sgd(0.1), 0.1)
    with pytest.raises(error, match=match):
        optx.minimise(bowl, solver, jnp.zeros(2), TARGET, options)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"sigma": -1.0}, "positive"),
        ({"sigma": 0.0}, "positive"),
        ({"sigma": None}, "nothing is smoothed"),
        ({"sigma": [0.1]}, "structure"),
        ({"num_samples": 7}, "multiple of 2"),
        ({"num_samples": 0}, "positive"),
        ({"baseline": "median"}, "baseline"),
    ],
)
def test_bad_settings_are_refused(change, match):
    solver = sd.FirstOrder(optax.sgd(0.1), **{"sigma": 0.1, **change})
    with pytest.raises(ValueError, match=match):
        run(bowl, solver, jnp.zeros(2), TARGET)


def test_what_is_no_optax_transformation_is_refused():
    factory: Any = optax.adam
    with pytest.raises(TypeError, match="optim"):
        sd.FirstOrder(factory, 0.1)


# the shared parts


def test_judge_takes_the_lowest_finite_and_the_first_of_equals():
    estimate = lambda y: (jnp.sqrt(y["a"]), y["a"])
    judged = lambda *values: judge(estimate, *({"a": jnp.float32(v)} for v in values))
    y, fun, stderr = judged(4.0, -1.0, 1.0)
    assert (y["a"], fun, stderr) == (1.0, 1.0, 1.0)
    assert judged(-1.0, -2.0)[0]["a"] == -1.0
    tags = {"a": jnp.zeros(()), "tag": jnp.asarray(1)}, {"a": jnp.zeros(()), "tag": jnp.asarray(2)}
    assert judge(estimate, *tags)[0]["tag"] == 1


def test_progress_records_the_best_of_the_finite_steps():
    progress = Progress.start(jnp.zeros(1), jnp.float32)
    for i, (fun, finite) in enumerate([(3.0, True), (1.0, False), (2.0, True), (2.5, True)]):
        values = jnp.float32(fun), jnp.float32(0.1 * i), {"a": 0.5, "b": jnp.array([0.1, 0.7])}
        progress = progress.after(jnp.full(1, i), *values, 10, jnp.asarray(finite))
    assert (progress.step, progress.evaluations) == (4, 40)
    assert (progress.fun, progress.sigma) == (2.5, jnp.float32(0.7))
    assert (progress.best_y, progress.best_fun) == (2, 2.0)
    assert progress.best_stderr == jnp.float32(0.2)


def test_project_takes_numbers_pytrees_and_open_sides():
    y = {"a": jnp.array([-2.0, 0.0, 2.0]), "b": jnp.float32(5.0)}
    clipped = project(y, (-1, {"a": jnp.array([3.0, -0.5, 1.0]), "b": None}))
    np.testing.assert_array_equal(clipped["a"], [-1.0, -0.5, 1.0])
    assert clipped["b"] == 5
    assert project(y, None) is y
