"""Where a search ends: at no minimum of a ripple, and soon after nothing is left but rounding."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

import smoothdiff as sd
from smoothdiff._params import take_apart
from smoothdiff._solvers._box import turned_inside
from smoothdiff._solvers._history import History
from smoothdiff._solvers._ratio_test import is_lower, rounding_alone
from smoothdiff._solvers._residual_search import ResidualSearch
from tests.parts import quick_of

KEY = jax.random.key(0)
PIXELS = np.linspace(0, 1, 32)


def rippled(y, args):
    """A bump that should be at 0.3, under ripples of a five-hundredth that fade out there."""
    bump = lambda at: jnp.exp(-(((PIXELS.astype(y.dtype) - at) / 0.2) ** 2))
    ripples = jnp.sin(3e3 * y + 40 * PIXELS.astype(y.dtype)) * jnp.abs(y - 0.3)
    return bump(y) - bump(0.3) + 0.5 * ripples


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
def test_the_minimum_of_a_ripple_is_not_taken_for_the_answer(seed, x64):
    result = sd.least_squares(
        rippled,
        jnp.asarray(0.75 + 0.003 * seed),
        solver=sd.GaussNewton(0.2),
        key=jax.random.key(seed),
        bounds=(0.0, 1.0),
        max_evaluations=200,
    )
    assert result.reason == "converged"
    assert float(result.y) == pytest.approx(0.3, abs=1e-6)


def peaks(y, args):
    """Twelve wells, 100 above zero, so that a value has few digits below a well's depth."""
    middles, depths, widths = args
    away = jnp.sum((y[None] - middles) ** 2, axis=1) / widths**2
    return 110 - jnp.max(depths * jnp.exp(-away / 2))


@pytest.mark.slow
def test_a_search_at_a_minimum_makes_room_for_others(x64):
    rng = np.random.default_rng(0)
    wells = rng.uniform(-4, 4, (12, 2)), rng.uniform(2, 8, 12), rng.uniform(0.5, 1.2, 12)
    searches = []
    for seed in range(5):
        result = sd.minimise(
            peaks,
            jnp.array([3.5, -3.5]),
            tuple(map(jnp.asarray, wells)),
            solver=sd.NewtonCG(1.0, restarts=100),
            key=jax.random.key(seed),
            bounds=(-4.0, 4.0),
            max_evaluations=600,
        )
        searches.append(int(result.state.search.searches))
    # each of them goes to the last digit of its well
    assert np.mean(searches) >= 5


def test_rounding_alone_is_more_values_than_levels(dtype):
    eps = float(jnp.finfo(dtype).eps)
    alone = jax.jit(rounding_alone)
    said = lambda funs, width: bool(
        alone(np.asarray(funs, dtype), np.ones(len(funs), bool), jnp.asarray(width))
    )
    levels = 3 + 4 * eps * np.array([0, 1, 1, 0, 2])
    assert said(levels, 1e-6)
    assert said([3.0] * 5, 1e-6)
    # wide samples that are alike are a plateau
    assert not said(levels, 0.1)
    # a slope has as many levels as values
    assert not said(3 + 4 * eps * np.array([0, 9, 17, 40, 28]), 1e-6)
    # evaluations that failed say nothing
    for left in range(2):
        some = np.arange(5) < left
        assert not alone(levels.astype(dtype), some, jnp.asarray(1e-6))
    # stairs of a hundredth are no rounding
    assert not said([3.0, 3.0, 3.01, 3.01, 3.0], 1e-6)


def test_lower_is_by_more_than_rounding(dtype):
    eps = float(jnp.finfo(dtype).eps)
    fun = jnp.asarray(5.0, dtype)
    assert not is_lower(fun * (1 - 4 * eps), fun)
    assert is_lower(fun * (1 - 40 * eps), fun)


@pytest.mark.parametrize("bounds", [(0.0, 1.0), (-np.inf, 1.0), (-1e30, 1.0)])
def test_samples_are_reflected_at_bounds(bounds):
    y = jnp.array([0.25, 0.5])
    params = take_apart(y, 1.0, bounds)
    inside, beyond = jnp.array([0.125, 0.75]), jnp.array([0.125, 1.25])
    np.testing.assert_array_equal(params.reflected(inside), inside)
    np.testing.assert_array_equal(params.reflected(beyond), [0.125, 0.75])
    far = params.reflected(jnp.array([-7.0, 30.0]))
    assert np.all((far >= bounds[0]) & (far <= bounds[1]))


@functools.partial(jax.jit, static_argnums=0)
def searched(dtype):
    """A search of three parameters that has evaluated its start, of value 1."""
    state = ResidualSearch.of(jnp.zeros(3, dtype), History.empty(20, 3, 1, dtype))
    return lowered(state, 1.0, 0)


@jax.jit
def lowered(search, value, count):
    points, rows, funs = (jnp.full(s, value, search.fall.to.dtype) for s in ((1, 3), (1, 1), (1,)))
    return search.kept(History.of(points, rows, funs, jnp.ones(1, bool))).marked(count)


@pytest.mark.parametrize(("dtype", "little"), [(jnp.float32, 3e-6), (jnp.float64, 3e-9)])
def test_what_falls_little_by_little_is_no_sign_of_an_end_unless_all_is_rounding(
    dtype, little, x64
):
    search = searched(dtype)
    assert (int(search.fall.since), float(search.fall.to)) == (0, 1)
    stale = []
    for step in range(1, 5):
        search = lowered(search, 1 - little * step, 1)
        stale.append(int(search.fall.since))
    # a third of what is noticeable each
    assert stale == [1, 2, 0 if dtype == jnp.float32 else 3, 1 if dtype == jnp.float32 else 0]
    search = lowered(search, 2.0, 5)
    assert int(search.fall.since) == stale[-1] + 5


@pytest.mark.slow
def test_evaluations_that_are_told_end_no_search():
    fun = lambda y: float(np.sum((np.asarray(y) - 1) ** 2))
    told = 3 * jax.random.normal(jax.random.key(1), (200, 2))
    told = sorted(told, key=fun)
    search = sd.Search(jnp.zeros(2), key=jax.random.key(0), solver=sd.NewtonCG(0.5, restarts=1))
    search.tell(told, [fun(y) for y in told])
    for _ in range(12):
        points = search.ask(1)
        search.tell(points, [fun(y) for y in points])
    assert not search.done
    assert int(search._state.restarts) == 1
    assert search.fun < 1e-6


TIMES = np.linspace(0, 3, 40)
NOISE = 0.05 * np.random.default_rng(0).standard_normal(40)
peak = lambda y, t: y[0] * jnp.exp(-3 * (t - y[1]) ** 2) + y[2] * t
FITS = {
    "line": (1, 12, lambda y, t: y[0] * t - 0.7 * t),
    "polynomial": (5, 24, lambda y, t: jnp.polyval(y, t, unroll=5) - jnp.cos(t)),
    "peak": (3, 60, lambda y, t: peak(y, t) - peak((1.0, 1.2, 0.5), t)),
    "decay": (2, 50, lambda y, t: y[0] * jnp.exp(-y[1] * t) - 2 * jnp.exp(-0.7 * t)),
}


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("fit", FITS)
def test_a_fit_of_noisy_data_ends_soon_after_its_minimum(fit, dtype, x64):
    """The model asks for nothing, and is right about points beside: no more is needed."""
    n, most, curve = FITS[fit]
    times, noise = TIMES.astype(dtype), NOISE.astype(dtype)
    residuals = lambda y, args: curve(y, times) + noise
    double = jax.jit(lambda y: curve(y, TIMES))
    slopes_at = jax.jit(jax.jacobian(lambda y: curve(y, times)))
    evaluations, above = [], []
    for seed in range(12):
        key = jax.random.key(seed)
        y0 = np.asarray(jax.random.uniform(key, (n,), dtype)) + np.asarray(0.3, dtype)
        result = sd.least_squares(residuals, y0, key=key)
        assert result.reason == "converged"
        evaluations.append(result.evaluations)
        best = minimize(lambda y: np.sum((double(y) + NOISE) ** 2) / 2, y0.astype(float))
        above.append(result.fun / best.fun - 1)
        # the checks are what the errors of parameters are taken from
        slopes = np.asarray(slopes_at(np.asarray(result.y, dtype)))
        exact = np.linalg.inv(slopes.T @ slopes) * (2 * result.fun / (len(NOISE) - n))
        found, right = (np.sqrt(np.diag(np.asarray(c))) for c in (result.covariance, exact))
        np.testing.assert_allclose(found, right, rtol=0.1)
    assert np.sum(np.array(evaluations) < most) >= 11
    # in float32 rounding decides how near a single one comes, but not that it is near
    exact = dtype == jnp.float64
    assert np.sum(np.array(above) < 1e-5) >= (12 if exact else 9)
    assert max(above) < 2e-4


def test_a_fit_ends_soon_after_rounding_is_all_that_is_left():
    """Steps of a few roundings of the parameters, which come to nothing, are no failures."""
    seen = []

    @sd.black_box(out=jax.ShapeDtypeStruct(TIMES.shape, jnp.float32))
    def residuals(y):
        row = y[0] * np.exp(-y[1] * TIMES) - 2 * np.exp(-0.7 * TIMES)
        seen.append(np.linalg.norm(row))
        return row.astype(y.dtype)

    for seed in range(3):
        seen.clear()
        key = jax.random.key(seed)
        y0 = 1 + jax.random.uniform(key, (2,)) / 2
        result = sd.least_squares(lambda y, args: residuals(y), y0, key=key)
        assert result.reason == "converged"
        np.testing.assert_allclose(result.y, [2.0, 0.7], rtol=1e-6)
        reached = np.argmax(np.array(seen) <= 1e-6 * seen[0])
        assert 5 < reached < len(seen) <= reached + 12


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_fit_that_leaves_nothing_ends_at_once(dtype, x64):
    """A short step that leaves 1e-20 of what is usual is the last one; in float32 1e-10.

    Not if no tolerance was given.
    """
    left = 1e-10 if dtype == jnp.float32 else 1e-20
    times = jnp.asarray(TIMES, dtype)
    curve = lambda y: y[0] / (1 + y[1] * times) + y[2] * jnp.sin(times)
    residuals = lambda y, args: curve(y) - curve(jnp.array([2, 0.7, 1], dtype))

    def run(seed, **settings):
        y0 = jax.random.uniform(jax.random.key(seed), (3,), dtype, 0.5, 1.5)
        solver = sd.GaussNewton(0.2, **settings)
        result = sd.least_squares(residuals, y0, key=KEY, solver=solver, max_evaluations=60)
        lowest = np.minimum.accumulate([record.fun for record in result.history])
        return result, np.sum(lowest < left / 10 * lowest[0])

    for seed in range(6):
        result, after = run(seed)
        assert result.reason == "converged"
        assert after <= 4
    assert run(0, rtol=0.0)[0].evaluations == 60


@pytest.mark.parametrize("follow", [{"target": 1e-2}, {"solver": sd.GaussNewton(2.0, restarts=20)}])
@pytest.mark.parametrize("y0", [0.2, 2.0])
def test_searches_that_may_follow_do_whatever_is_little(follow, y0):
    """The loss is 24.5 in a minimum at 1 and zero at 8; usual are 1e13."""
    fun = lambda y, _: jnp.stack([1e6 * (y - 1) * (y - 8), y - 8])
    limits = {"bounds": (0.0, 10.0), "max_evaluations": 200}
    result = sd.least_squares(fun, jnp.asarray(y0), key=KEY, **limits, **follow)
    assert float(result.fun) < 1e-2


def test_a_wrong_model_that_asks_for_a_tiny_step_has_not_converged():
    # the penalty beyond the jump makes the slope so steep that the step is lost in rounding
    fun = lambda y, args: jnp.where(y >= 1, y, 1e8)
    result = sd.least_squares(
        fun, jnp.asarray(2.0), key=jax.random.key(0), solver=sd.GaussNewton(0.5)
    )
    assert float(result.y) == pytest.approx(1, abs=0.01)


@pytest.mark.slow
def test_so_many_evaluations_at_once_end_a_search_after_a_few_steps():
    """Not after one that is no lower, and not never."""
    solver, key = sd.NewtonCG(0.5, num_samples=64), jax.random.key(0)
    bowl = lambda y, args: jnp.sum((y - 1) ** 2) + 1
    result = sd.minimise(bowl, jnp.zeros(1), key=key, solver=solver, max_evaluations=2000)
    assert result.reason in ("converged", "stalled")
    assert result.fun == 1
    assert 5 <= len(result.history) < 20


CORNERS = [(n, at) for n in (1, 2, 4) for at in (0.0, 1.0)]


@pytest.mark.parametrize("corner", quick_of(CORNERS, [(1, 0.0), (2, 1.0)]))
def test_a_start_on_a_bound_is_not_taken_for_a_minimum_nearby(corner):
    n, at = corner
    away = lambda y, c: jnp.abs(y - at) - c
    bowl = lambda y, c: jnp.sum(away(y, c) ** 2)
    roof = lambda y, c: 1 + jnp.sum(jnp.abs(away(y, c)))
    for fun in (bowl, roof):
        for c in (0.02, 0.05, 0.09, 0.4):
            start, least = np.full(n, at, np.float32), np.float32(c)
            result = sd.minimise(fun, start, least, key=KEY, bounds=(0.0, 1.0), max_evaluations=400)
            high, low = fun(start, least), fun(start + (1 - 2 * at) * least, least)
            assert float((result.fun - low) / (high - low)) < 1e-3, (fun, c)


def test_a_first_point_that_a_bound_cuts_off_is_half_as_far_on_the_other_side():
    def ends(start, sigma):
        params = take_apart(jnp.asarray([start]), sigma, (0.0, 1.0))
        steps = sigma * jnp.asarray([[1.0], [-1.0]])
        return jax.jit(lambda: turned_inside(params, jnp.asarray([start]), steps))()[:, 0].tolist()

    assert ends(0.5, 0.25) == [0.75, 0.25]
    assert ends(0.0, 0.25) == [0.25, 0.125]
    assert ends(1.0, 0.25) == [0.875, 0.75]
    # where a box is narrow beside sigma both ends are seen from its middle
    assert ends(0.5, 2.0) == [1.0, 0.0]
    assert ends(0.4375, 2.0) == [1.0, 0.0]
    assert ends(0.25, 2.0) == [1.0, 0.625]
