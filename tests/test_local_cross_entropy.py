"""Cross-entropy with local support: the formula, known optima, counting, bounds, noise, faults."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import smoothdiff as sd
from smoothdiff._params import take_apart
from smoothdiff._solvers._local_ensemble import Blame
from smoothdiff._solvers._residual_batch import ResidualBatch
from smoothdiff._solvers.local_cross_entropy import _even, _fit

KEY = jax.random.key(3)
N = 60
ON = np.random.default_rng(0).random(N) < 0.5
HIDDEN = np.random.default_rng(1).uniform(-1, 1, N)
ALONE = sd.local_support(0, ndim=1)
EVALUATED = []


# one compiled step does for all, since `which` is data


def switches(y, hidden):
    """A parameter is on where it is over a half; no slope anywhere."""
    return (y > 0.5).astype(y.dtype) - (hidden > 0).astype(y.dtype)


def two_valleys(y, hidden):
    """The wrong one, around 0.2 - hidden, is as wide as the right one and a little less deep."""
    right, wrong = jnp.abs(y - hidden), jnp.abs(y - jnp.where(hidden > 0, hidden - 1, hidden + 1))
    return jnp.minimum(right, wrong + 0.1)


def noisy(y, hidden):
    bits = jax.lax.bitcast_convert_type(jnp.sum(y).astype(jnp.float32) * 1e3, jnp.int32)
    return y - hidden + 0.1 * jax.random.normal(jax.random.key(bits), y.shape, y.dtype)


def holes(y, hidden):
    """A quarter of the first population fails."""
    return jnp.where(y[7] > 0.5, jnp.nan, y - jnp.minimum(hidden, 0.4))


def far(y, hidden):
    """Nothing within ten sigmas says anything."""
    return jnp.round(y / 20) - 1


def watched(y, hidden):
    jax.debug.callback(lambda one: EVALUATED.append(np.asarray(one)), y)
    return y - hidden


PROBLEMS = [switches, two_valleys, noisy, holes, far, watched]


def any_of(y, args):
    which, hidden = args
    return jax.lax.switch(which, PROBLEMS, y, hidden)


def fit(problem, hidden=HIDDEN, dtype: Any = np.float32, bounds: Any = (-1.0, 1.0), **run):
    names = "sigma", "nonfinite", "atol", "num_samples"
    settings = {name: run.pop(name) for name in names if name in run}
    args = jnp.asarray(PROBLEMS.index(problem), jnp.int32), jnp.asarray(hidden.astype(dtype))
    solver = sd.LocalCrossEntropy(ALONE, **settings)
    run = {"key": KEY, "max_evaluations": 400, "bounds": bounds} | run
    y0 = run.pop("y0", np.full(N, 0.3, dtype))
    return sd.least_squares(any_of, y0, args, solver=solver, **run)


# the step


def test_mean_and_spread_are_those_of_the_best_quarter(x64):
    rng = np.random.default_rng(1)
    matrix = (rng.random((5, 4)) < 0.5).astype(float)
    matrix[:, 3] = 0  # a parameter that moves nothing: all are as good
    points, rows = rng.normal(size=(15, 4)), rng.normal(size=(15, 10))
    rows[2] = np.nan
    middle = rng.normal(size=4)

    @jax.jit
    def fits(points, rows, middle):
        blame = Blame.of(sd.matrix_support(matrix), lambda x: x, jnp.zeros(4))
        batch = ResidualBatch.of(points, rows, jnp.asarray(15))
        return _fit(blame, batch, None), _fit(blame, batch, middle)

    (mean, spread, flat), (_, around, _) = jax.tree.map(np.asarray, fits(points, rows, middle))
    np.testing.assert_array_equal(flat, [False, False, False, True])
    costs = (rows.reshape(15, 5, 2) ** 2).sum(axis=2) @ matrix
    for j in range(4):
        elite = np.delete(points[:, j], 2) if j == 3 else points[np.argsort(costs[:, j])[:4], j]
        np.testing.assert_allclose(mean[j], elite.mean(), rtol=1e-12)
        # as if of four, however many are as good as the last
        for found, of in ((spread, elite.mean()), (around, middle[j])):
            expected = np.sqrt(np.mean((elite - of) ** 2) * 4 / 3)
            np.testing.assert_allclose(found[j], expected, rtol=1e-12)


def test_the_first_population_is_spread_evenly_over_the_bounds(key):
    params = take_apart(jnp.zeros(50), 1.0, (-1.0, 3.0))
    points = np.asarray(jax.jit(lambda key: _even(params, key, 16))(key))
    layers = np.sort(np.floor((points + 1) / 4 * 16), axis=0)
    np.testing.assert_array_equal(layers, np.arange(16)[:, None] * np.ones(50))


# runs


def test_switches_are_found_in_three_populations():
    result = fit(switches, bounds=(0.0, 1.0), max_evaluations=200, target=0.0)
    np.testing.assert_array_equal(np.asarray(result.y) > 0.5, HIDDEN > 0)
    assert (result.fun, result.reason) == (0.0, "target")
    assert result.history[-1].evaluations <= 3 * 32
    assert result.result == optx.RESULTS.successful


def test_no_start_leads_into_the_wrong_valley():
    wrong = np.where(HIDDEN > 0, HIDDEN - 1, HIDDEN + 1).astype(np.float32)
    for y0 in (wrong, np.zeros(N, np.float32)):
        result = fit(two_valleys, y0=y0, max_evaluations=800)
        assert np.mean(np.abs(result.y - HIDDEN) < 0.05) > 0.9


def test_it_says_when_it_has_converged(x64):
    result = fit(watched, dtype=np.float64, atol=0.01, max_evaluations=2000)
    assert (result.reason, result.y.dtype) == ("converged", np.float64)
    np.testing.assert_allclose(result.y, HIDDEN, atol=0.02)
    assert np.all(np.diff([r.fun for r in result.history]) <= 0)
    assert result.history[-1].sigma < 0.03


def test_without_bounds_it_begins_around_the_start():
    result = fit(watched, bounds=None, sigma=0.5, max_evaluations=800)
    np.testing.assert_allclose(result.y, HIDDEN, atol=0.05)
    assert np.isfinite(result.history[0].smoothed)
    assert result.history[0].sigma == pytest.approx(0.5)


def test_a_plateau_is_left():
    result = fit(far, bounds=None, sigma=0.5, y0=np.zeros(N, np.float32), max_evaluations=800)
    assert result.fun < 0.1 * N / 2


def test_no_point_outside_the_bounds_is_evaluated_and_all_are_counted():
    EVALUATED.clear()
    result = fit(watched, bounds=(-0.5, 0.8), max_evaluations=300)
    jax.effects_barrier()
    assert result.evaluations == len(EVALUATED) <= 300
    assert np.min(EVALUATED) >= np.float32(-0.5)
    assert np.max(EVALUATED) <= np.float32(0.8)
    assert any(np.array_equal(result.y, one) for one in EVALUATED)
    np.testing.assert_allclose(result.y, np.clip(HIDDEN, -0.5, 0.8), atol=0.15)


def test_noise_is_averaged_by_the_population():
    """Each parameter sees the noise of its own term alone."""
    result = fit(noisy, max_evaluations=800)
    assert np.sqrt(np.mean((np.asarray(result.y) - HIDDEN) ** 2)) < 0.1


@pytest.mark.slow
def test_trees_spaces_and_channels_that_share_a_cell():
    target = {"a": jax.random.uniform(jax.random.key(5), (4, 4, 3)), "b": jnp.full((4, 4), 7.0)}

    def fun(y, args):
        apart = [y["a"] - target["a"], (jnp.log(y["b"]) - jnp.log(target["b"]))[..., None]]
        return jnp.concatenate(apart, axis=-1)

    cells = sd.local_support(0)
    result = sd.least_squares(
        fun,
        {"a": jnp.full((4, 4, 3), 0.5), "b": jnp.full((4, 4), 1.0)},
        key=KEY,
        solver=sd.LocalCrossEntropy(
            lambda y: cells(jnp.concatenate([y["a"], y["b"][..., None]], axis=-1)), batch_size=7
        ),
        space={"a": sd.Range(0.0, 1.0), "b": sd.Range(0.1, 100.0, log=True)},
        max_evaluations=900,
    )
    np.testing.assert_allclose(result.y["a"], target["a"], atol=0.15)
    np.testing.assert_allclose(result.y["b"], 7.0, rtol=0.3)


def test_a_resumed_run_ends_with_the_same_bits(tmp_path):
    path = tmp_path / "run.npz"
    whole = fit(watched, max_steps=6)
    stopped = fit(watched, max_steps=6, checkpoint=path, callback=lambda r: r.step == 2)
    assert stopped.reason == "callback"
    resumed = fit(watched, max_steps=6, checkpoint=path)
    np.testing.assert_array_equal(resumed.y, whole.y)
    assert (resumed.fun, resumed.evaluations) == (whole.fun, whole.evaluations)


def test_optimistix_makes_the_same_steps():
    args = jnp.asarray(PROBLEMS.index(watched), jnp.int32), jnp.asarray(HIDDEN, jnp.float32)
    y0 = np.full(N, 0.3, np.float32)
    found = optx.least_squares(
        any_of,
        sd.LocalCrossEntropy(ALONE),
        jnp.asarray(y0),
        args,
        options={"key": KEY, "bounds": (-1.0, 1.0)},
        max_steps=4,
        throw=False,
    )
    assert found.result == optx.RESULTS.nonlinear_max_steps_reached
    np.testing.assert_allclose(found.value, fit(watched, max_steps=4).y, atol=1e-5)


# faults and bad input


def test_samples_that_fail_are_the_worst():
    result = fit(holes, nonfinite="drop", max_evaluations=800)
    np.testing.assert_allclose(result.y, np.minimum(HIDDEN, 0.4), atol=0.1)
    with pytest.raises(sd.MinimiseError, match='nonfinite="drop"') as error:
        fit(holes)
    assert np.all(np.isfinite(error.value.result.y))


def test_bad_arguments():
    with pytest.raises(ValueError, match="at least 9 evaluations"):
        sd.LocalCrossEntropy(ALONE, num_samples=8)
    with pytest.raises((ValueError, TypeError), match="nonfinite"):
        sd.LocalCrossEntropy(ALONE, nonfinite="ignore")  # pyright: ignore
    for support in (None, 3):
        with pytest.raises(TypeError, match="support"):
            sd.LocalCrossEntropy(support)  # pyright: ignore
    with pytest.raises(TypeError, match="no schedule"):
        sd.LocalCrossEntropy(ALONE, sigma=lambda step: 0.1)
    for bounds in (None, (0.0, None), (None, 1.0)):
        with pytest.raises(ValueError, match="finite bounds for each parameter, or sigma="):
            fit(watched, bounds=bounds)
    with pytest.raises(ValueError, match="first axes are those of the terms"):
        sd.least_squares(
            lambda y, args: y[:-1],
            jnp.zeros(N),
            key=KEY,
            solver=sd.LocalCrossEntropy(ALONE),
            bounds=(0, 1),
        )
    with pytest.raises(ValueError, match="every leaf"):
        sd.least_squares(
            lambda y, args: y["a"],
            {"a": jnp.zeros(N), "b": jnp.zeros(())},
            key=KEY,
            solver=sd.LocalCrossEntropy(lambda y: ALONE(y["a"]), sigma={"a": 0.1, "b": None}),
        )
