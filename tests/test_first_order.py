"""FirstOrder under optimistix: what it converges to, what it accepts, and what it refuses."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest

import smoothdiff as sd
from smoothdiff._seen import Seen
from smoothdiff._solvers._base import Progress, project

KEY = jax.random.key(2)
TARGET = jnp.array([0.6, -0.4])
SAM = optax.contrib.sam(optax.sgd(0.1), optax.sgd(0.05))
SUCCESS, MAX_STEPS, NONFINITE = (
    optx.RESULTS.successful,
    optx.RESULTS.nonlinear_max_steps_reached,
    optx.RESULTS.nonfinite,
)


def plateaus(y, target):
    return jnp.sum(jnp.floor(8 * jnp.abs(y - target)))


def bowl(y, target):
    return jnp.sum((y - target) ** 2)


def flat(y, target):
    return jnp.zeros((), y.dtype)


def holes(y, target):
    return jnp.where(jnp.cos(50 * y[0]) > 0.8, jnp.nan, bowl(y, target))


PROBLEMS = [plateaus, bowl, flat, holes]


def run(fun, solver, y0, args=None, *, bounds=None, steps=200, key=KEY, **rest):
    options = {"key": key} if bounds is None else {"key": key, "bounds": bounds}
    return optx.minimise(fun, solver, y0, args, options, max_steps=steps, throw=False, **rest)


@jax.jit
def crossing(which, y0, key):
    """A run on one of the problems; compiled once for all, since which of them is data."""
    solver = sd.FirstOrder(optax.adam(0.05), optax.linear_schedule(0.3, 0.05, 200))
    fun = lambda y, target: jax.lax.switch(which, PROBLEMS, y, target)
    return run(fun, solver, y0, TARGET.astype(y0.dtype), key=key)


def cross(problem, y0=(0.0, 0.0), dtype: Any = np.float32, key=KEY):
    which = jnp.asarray(PROBLEMS.index(problem), jnp.int32)
    return crossing(which, jnp.asarray(np.asarray(y0, dtype)), key)


# what it finds


def test_crosses_plateaus_in_both_precisions(dtype):
    solution = cross(plateaus, dtype=dtype)
    assert solution.value.dtype == solution.stats["fun"].dtype == dtype
    # the lowest plateau is the square of half-width 1/8 around the target
    np.testing.assert_allclose(solution.value, TARGET, atol=0.06)
    assert solution.result == MAX_STEPS
    assert solution.stats["evaluations"] == 200 * 8 + 5 + 8


def test_gradient_descent_follows_the_smoothed_gradient():
    """On a bowl the smoothed gradient is the gradient: sgd contracts by 1 - 2 lr a step."""
    solver = sd.FirstOrder(optax.sgd(0.1), 0.01, num_samples=4096)
    state = run(bowl, solver, jnp.ones(2), jnp.zeros(2), steps=5).state
    # the batch of the fifth step was at the fourth iterate; of the iterate, each step adds an error
    # of 0.2 sqrt(3 / pairs) = 0.008, and of its square, after four, 0.03
    assert state.progress.smoothed == pytest.approx(2 * 0.8**8, rel=0.1)


@pytest.mark.slow
def test_pytrees_with_a_sigma_for_each_leaf_and_ad_where_there_is_none_within_bounds():
    seen = []
    host = lambda y: seen.append(np.array(y)) or np.sum((np.round(8 * y) / 8 - [2, -0.5, 0]) ** 2)
    box = sd.black_box(host, jax.ShapeDtypeStruct((), jnp.float32))

    def fun(y, args):
        free, closed = y["c"][0], y["c"][1]
        return box(jnp.append(y["a"], y["b"])) + (free - 2) ** 2 + (closed - 3) ** 2

    y0 = {"a": np.array([0.0, 0.5]), "b": 0.0, "c": [0.0, 0.0]}
    low = {"a": np.array([-1.0, 0.1]), "b": None, "c": [None, None]}
    high = {"a": 1.0, "b": 0.5, "c": [None, 2.5]}
    solver = sd.FirstOrder(optax.adam(0.1), {"a": 0.1, "b": 0.2, "c": [None, None]}, batch_size=4)
    result = sd.minimise(fun, y0, key=KEY, solver=solver, max_steps=120, bounds=(low, high))
    # pulled towards (2, -0.5) and 3, across the bounds (1, 0.1) and 2.5
    np.testing.assert_allclose(result.y["a"], [1.0, 0.1], atol=0.05)
    np.testing.assert_allclose(result.y["b"], 0.0, atol=0.15)
    np.testing.assert_allclose(result.y["c"], [2.0, 2.5], atol=0.02)
    points = np.stack(seen)
    assert len(points) == result.evaluations
    assert np.all(points[:, 0] <= 1)
    assert np.all(points[:, 1] >= np.float32(0.1))
    assert np.all(points[:, 2] <= 0.5)
    assert points[:, 2].min() < -0.1
    for record in result.history:
        assert record.sigma == np.float32(0.2)
        assert record.y["a"][0] <= 1
        assert record.y["a"][1] >= np.float32(0.1)
        assert record.y["c"][1] <= 2.5


def test_the_average_wanders_less_than_noise_makes_the_iterates():
    def noisy(y, key):
        bits = jax.lax.bitcast_convert_type(y, jnp.uint32)
        return y**2 + jax.random.normal(jax.random.fold_in(key, bits))

    solver = sd.FirstOrder(optax.sgd(0.2), 0.5, num_samples=16)
    seeds = jnp.arange(64)

    def final(seed):
        key = jax.random.key(seed)
        return run(noisy, solver, 0.0, key, key=jax.random.key(500 + seed)).state.average

    average = jax.jit(jax.vmap(final))(seeds)
    # sgd with step a on y^2 and gradient noise s^2 = (1 + ...) / (16 * 0.5^2) wanders with variance
    # a s^2 / (4 (1 - a)), of which the average over ten steps keeps about a third
    wander = 0.2 * (1 / (16 * 0.25)) / (4 * 0.8)
    assert np.mean(average**2) < 0.6 * wander


# how it runs


def test_vmap_over_keys_and_starts_is_a_loop_over_them():
    one = lambda key, y0: crossing(PROBLEMS.index(bowl), y0, key).value
    keys, starts = jax.random.split(KEY, 3), np.array([[0, 0], [1, 1], [-1, 0.5]], np.float32)
    many = jax.jit(jax.vmap(one))(keys, starts)
    for key, y0, value in zip(keys, starts, many, strict=True):
        np.testing.assert_allclose(value, cross(bowl, y0, key=key).value, atol=2e-4)


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
    """And a run converges at its tolerance, and its aux is that of a sample."""
    plateau = optax.contrib.reduce_on_plateau(factor=0.5, patience=2, accumulation_size=1)
    solver = sd.FirstOrder(optax.chain(optax.sgd(0.05), plateau), 0.01, atol=1e-4)
    fun = lambda y, args: (bowl(y, args), {"y": y})
    solution = run(fun, solver, jnp.zeros(2), TARGET, has_aux=True)
    np.testing.assert_allclose(solution.value, TARGET, atol=0.01)
    assert optax.tree.get(solution.state.opt_state, "scale") < 1
    assert solution.result == SUCCESS
    assert 20 < solution.stats["num_steps"] < 200
    assert solution.state.stall == 5
    assert not np.array_equal(solution.aux["y"], solution.value)
    np.testing.assert_allclose(solution.aux["y"], TARGET, atol=0.05)


@pytest.mark.parametrize(("num_samples", "baseline"), [(2, "mean"), (3, "center")])
def test_a_single_pair_has_a_gradient_but_no_standard_error(num_samples, baseline):
    solver = sd.FirstOrder(optax.adam(0.02), 0.2, num_samples=num_samples, baseline=baseline)
    solution = run(plateaus, solver, jnp.zeros(2), TARGET, steps=400)
    np.testing.assert_allclose(solution.value, TARGET, atol=0.1)
    assert np.isnan(solution.stats["stderr"])
    assert np.isfinite(solution.stats["fun"])


def test_drop_leaves_failed_samples_out():
    drop = sd.FirstOrder(optax.adam(0.05), 0.1, num_samples=32, nonfinite="drop")
    solution = run(holes, drop, jnp.zeros(2), TARGET, steps=100)
    assert solution.result == MAX_STEPS
    np.testing.assert_allclose(solution.value, TARGET, atol=0.1)
    assert cross(holes).result == NONFINITE


# when it stops


def test_without_a_tolerance_no_plateau_is_a_reason_to_stop():
    """Not even one where every update is zero."""
    solution = cross(flat)
    assert solution.result == MAX_STEPS
    np.testing.assert_array_equal(solution.value, 0)


def test_a_failed_step_keeps_the_iterate_and_says_so():
    """The first update leads out of the domain of the function, where the second fails."""
    fun = lambda y, args: jnp.where(jnp.abs(y[0]) > 10, jnp.nan, bowl(y, TARGET))
    solution = run(fun, sd.FirstOrder(optax.sgd(30.0), 0.1), jnp.ones(2))
    assert solution.result == NONFINITE
    assert solution.stats["num_steps"] == 2
    # the best of those of the first batch
    np.testing.assert_allclose(solution.value, jnp.ones(2), atol=0.4)
    assert solution.stats["fun"] == pytest.approx(0.4**2 + 1.4**2, rel=0.5)
    assert solution.stats["fun"] < 0.4**2 + 1.4**2


# bad input


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({}, ValueError, r"options=\{\"key\": jax\.random\.key\(0\)\}"),
        ({"key": 0}, TypeError, r"jax\.random\.key\(0\)"),
        ({"key": KEY, "bound": (0, 1)}, ValueError, '"key", "bounds" and "takes_key"'),
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
        ({"num_samples": 0}, "at least one"),
        ({"baseline": "median"}, "baseline"),
    ],
)
def test_bad_settings_are_refused(change, match):
    settings = {"sigma": 0.1, **change}
    with pytest.raises(ValueError, match=match):
        run(bowl, sd.FirstOrder(optax.sgd(0.1), **settings), jnp.zeros(2), TARGET)


def test_what_is_no_optax_transformation_is_refused():
    factory: Any = optax.adam
    with pytest.raises(TypeError, match="optim"):
        sd.FirstOrder(factory, 0.1)
    steps: Any = optax.MultiSteps(optax.adam(0.1), 2)
    with pytest.raises(TypeError, match=r"write optim.gradient_transformation\(\)"):
        sd.FirstOrder(steps, 0.1)
    with pytest.raises(TypeError, match=r"write optimizer.gradient_transformation\(\)"):
        sd.ZeroGrads(0.1, optimizer=steps)


@pytest.mark.parametrize(
    ("optim", "match"),
    [
        (optax.lbfgs(), r"ZeroGrads\(sigma, optimizer="),
        (optax.chain(optax.clip(1.0), optax.lbfgs()), r"ZeroGrads\(sigma, optimizer="),
        (SAM, r"GradientTransformation\(part.init, part.update\)"),
        (optax.chain(optax.clip(1.0), SAM), r"GradientTransformation\(part.init, part.update\)"),
    ],
)
def test_a_transformation_that_needs_more_says_what_to_write(optim, match):
    with pytest.raises(TypeError, match=match):
        run(bowl, sd.FirstOrder(optim, 0.1), jnp.zeros(2), TARGET)


def test_a_transformation_that_takes_no_more_than_others_can_be_wrapped():
    wrapped = optax.GradientTransformation(SAM.init, SAM.update)
    result = sd.minimise(
        bowl, jnp.zeros(2), TARGET, key=jax.random.key(0), solver=sd.FirstOrder(wrapped, 0.1)
    )
    np.testing.assert_allclose(result.y, TARGET, atol=0.1)


# the shared parts


def test_progress_records_the_best_of_the_finite_steps_and_the_lowest_of_all():
    progress = Progress.start(jnp.zeros(1), jnp.float32)
    assert (progress.lowest_y, progress.lowest_fun, progress.start_y) == (0, np.inf, 0)
    steps = [(3.0, True, 9.0), (1.0, False, 4.0), (2.0, True, 5.0), (2.5, True, np.inf)]
    for i, (fun, finite, value) in enumerate(steps):
        values = jnp.float32(fun), jnp.float32(0.1 * i), {"a": 0.5, "b": jnp.array([0.1, 0.7])}
        seen = Seen(jnp.full(1, 10.0 * i), jnp.float32(value))
        progress = progress.after(jnp.full(1, 1.0 * i), *values, 10, jnp.asarray(finite), seen)
    assert (progress.step, progress.evaluations) == (4, 40)
    assert (progress.smoothed, progress.sigma) == (2.5, jnp.float32(0.7))
    assert (progress.best_y, progress.best_smoothed) == (2, 2.0)
    assert (progress.lowest_y, progress.lowest_fun, progress.start_y) == (10, 4.0, 0)


def test_project_takes_numbers_pytrees_and_open_sides():
    y = {"a": jnp.array([-2.0, 0.0, 2.0]), "b": jnp.float32(5.0)}
    clipped = project(y, (-1, {"a": jnp.array([3.0, -0.5, 1.0]), "b": None}))
    np.testing.assert_array_equal(clipped["a"], [-1.0, -0.5, 1.0])
    assert clipped["b"] == 5
    assert project(y, None) is y


def test_a_batch_that_is_lost_is_drawn_again(key):
    """Sixty percent of all points are lost, so more than half of most batches."""

    def holes(y, args):
        lost = jnp.mod(jnp.floor(y[0] * 1e4), 10) < 6
        return jnp.where(lost, jnp.nan, jnp.abs(y[0] - 1))

    solver = sd.FirstOrder(optax.sgd(0.1), 0.3, num_samples=6, nonfinite="drop")
    run = partial(sd.minimise, y0=jnp.zeros(1), key=key, solver=solver, max_steps=40)
    result = run(holes)
    assert result.reason == "max_steps"
    assert result.evaluations >= 40 * 6  # lost ones count
    assert abs(float(result.y[0]) - 1) < 0.3
    with pytest.raises(sd.MinimiseError, match="NaN or infinite") as info:
        run(lambda y, args: jnp.nan * y[0])
    assert len(info.value.result.history) <= 6
