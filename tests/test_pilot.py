"""Where the first points are all the same, pairs of points further and further away say more."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import smoothdiff as sd
from smoothdiff._solvers._pilot import PAIRS, Pilot

KEY = jax.random.key(0)


def target(n):
    """Three and a half away, so that the start is in the middle of a plateau."""
    return 3.5 * jnp.ones(n) / n**0.5


def plateaus(y, args):
    return jnp.floor(jnp.linalg.norm(y - target(len(y))))


def terraces(y, args):
    return jnp.floor(y - target(len(y))) + 0.5


def first_lower(result):
    start = result.history[0].fun
    return next((r.evaluations for r in result.history if r.fun < start), None)


def test_pairs_are_four_times_as_far_every_time():
    z = jax.random.normal(KEY, (PAIRS, 3))

    @jax.jit
    def first(z):
        pilot = Pilot.start(z[0])
        return pilot.steps(z, 2 * PAIRS), pilot.steps(z, 3)

    steps, three = map(np.asarray, first(z))
    np.testing.assert_allclose(steps[::2], -steps[1::2])
    lengths = 4.0 ** np.arange(1, PAIRS + 1)
    np.testing.assert_allclose(np.linalg.norm(steps[::2], axis=1), lengths, rtol=1e-5)
    np.testing.assert_allclose(three, steps[:3])


@pytest.mark.parametrize(
    ("changed", "good", "length"),
    [
        ([False, False], [True, True], 0.0),
        ([False, True], [True, True], 64.0),
        ([True, True], [True, True], 16.0),
        # what is not finite is too far away
        ([False, True], [True, False], 16.0),
    ],
)
def test_the_nearest_change_says_how_far_the_first_points_are(changed, good, length):
    steps = np.array([[16.0, 0.0], [0.0, 64.0]], np.float32)
    before = Pilot.start(jnp.zeros(2))
    pilot = jax.jit(Pilot.after)(before, steps, np.array(changed), np.array(good))
    assert (int(pilot.tried), float(pilot.length)) == (2, length)


@pytest.mark.slow
@pytest.mark.parametrize(
    "run", [pytest.param(sd.minimise, marks=pytest.mark.slow), sd.least_squares]
)
def test_a_sigma_that_is_far_too_small_costs_few_evaluations(run):
    fun, first = (plateaus, 5) if run is sd.minimise else (terraces, 3)
    for sigma in (0.1, 0.01):
        result = run(fun, jnp.zeros(2), key=KEY, sigma=sigma, max_steps=2 * first + 10)
        # first points twice, at most four pairs, and two steps
        assert first_lower(result) is not None, sigma


@pytest.mark.slow
@pytest.mark.parametrize("n", [2, 5])
@pytest.mark.parametrize("sigma", [0.1, 0.01])
def test_a_sigma_that_is_far_too_small_is_no_trouble(n, sigma):
    """From 4 starts, at a distance of 3.5 in any direction."""
    found = []
    for seed in range(4):
        key = jax.random.key(seed)
        y0 = jax.random.normal(key, (n,))
        y0 = target(n) + 3.5 * y0 / jnp.linalg.norm(y0)
        result = sd.minimise(plateaus, y0, key=key, sigma=sigma)
        found.append(result.fun)
        assert result.evaluations < 40 * (n + 1) + 160
    assert np.sum(np.array(found) == 0) >= 3


@pytest.mark.slow
def test_a_function_that_fails_further_away_is_searched_nearby():
    """Without nonfinite="drop": nobody asked for points so far away."""
    fun = lambda y, _: jnp.where(jnp.max(jnp.abs(y)) < 10, plateaus(y, None), jnp.nan)
    result = sd.minimise(fun, jnp.zeros(2), key=KEY, sigma=0.2, max_steps=40)
    assert result.fun == 0
    narrow = lambda y, _: jnp.where(jnp.max(jnp.abs(y)) < 1, 0 * jnp.sum(y), jnp.nan)
    result = sd.minimise(narrow, jnp.zeros(2), key=KEY, sigma=0.1, max_steps=9)
    assert result.evaluations > 9


@pytest.mark.slow
def test_what_is_the_same_everywhere_is_left_alone_in_the_end():
    result = sd.minimise(lambda y, _: 0 * jnp.sum(y), jnp.zeros(2), key=KEY, sigma=0.1)
    assert result.reason in ("stalled", "noise")
    assert result.evaluations < 120


@pytest.mark.slow
def test_bounds_hold():
    seen = []

    def fun(y):
        seen.append(np.array(y))
        return np.float32(0)

    box = sd.black_box(fun, jax.ShapeDtypeStruct((), jnp.float32))
    bounds = -1.0, 2.0
    sd.minimise(lambda y, _: box(y), jnp.zeros(2), key=KEY, sigma=0.1, bounds=bounds, max_steps=15)
    assert np.min(seen) >= -1
    assert np.max(seen) <= 2
    # all over the box, and not on its faces
    assert np.ptp(seen) > 2
    assert np.mean(np.all((np.array(seen) > -1) & (np.array(seen) < 2), axis=1)) > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("residuals", [False, True])
def test_a_needle_in_a_box_is_found(residuals):
    """One of 16 points is on it; the start is on the plateau around it."""
    found = 0
    for seed in range(4):
        needle = jax.random.uniform(jax.random.key(seed), (4,), minval=0.3, maxval=0.7)

        def rows(y, args, needle=needle):
            away = y - needle
            # beside it is a hill, and some of the box fails
            around = jnp.where(y[0] > 0.9, 1.2, jnp.where(y[1] > 0.95, jnp.nan, 1.0))
            return jnp.where(jnp.max(jnp.abs(away)) < 0.25, away, around)

        def fun(y, args, rows=rows):
            return jnp.sum(rows(y, args) ** 2) / 2

        call, of = (sd.least_squares, rows) if residuals else (sd.minimise, fun)
        settings = {"key": jax.random.key(seed), "bounds": (0.0, 1.0), "max_evaluations": 200}
        found += call(of, jnp.full(4, 0.05), **settings).fun < 0.1
    assert found == 4


@pytest.mark.slow
def test_the_host_takes_the_steps_of_optimistix(x64):
    solver, options = sd.GaussNewton(0.01), {"key": KEY}
    result = sd.least_squares(terraces, jnp.zeros(2), key=KEY, solver=solver, max_steps=20)
    found = optx.least_squares(
        terraces, solver, jnp.zeros(2), options=options, max_steps=20, throw=False
    )
    np.testing.assert_allclose(result.y, found.state.progress.lowest_y, rtol=1e-6, atol=1e-9)
