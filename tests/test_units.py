"""Parameters of very different units, and starts far too small: what a call without sigma finds."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import smoothdiff as sd
from smoothdiff._default_solver import default_solver
from tests.parts import quick_of

TIMES = jnp.linspace(0, 1, 30)
UNITS = jnp.array([1e-6, 1.0, 1e3])
SOLVER, OPTIONS = sd.GaussNewton(0.2), {"key": jax.random.key(0)}
FOUND = UNITS * jnp.array([3.0, 2.0, 0.5])
calls = pytest.mark.parametrize(
    "call", [sd.least_squares, sd.minimise], ids=["residuals", "number"]
)


def decay(y):
    """A rate of about 1; amplitudes a million times smaller and a thousand times larger."""
    return 1e6 * y[0] * jnp.exp(-y[1] * TIMES) + 1e-3 * y[2] * TIMES


def solved(call, residuals, y0, **options):
    """The result of a call, of thirty residuals or of half the sum of their squares.

    Always so many, and mostly three parameters: then there is little to compile.
    """
    rows = lambda y, args: jnp.resize(residuals(y), (30,))
    value = lambda y, args: jnp.sum(rows(y, args) ** 2) / 2
    return call(value if call is sd.minimise else rows, y0, key=jax.random.key(0), **options)


def sigma_of(*numbers):
    return np.asarray(default_solver(jnp.array(numbers), None, None, True).sigma)


def test_numbers_of_one_order_share_the_largest():
    np.testing.assert_allclose(sigma_of(3.0, -20.0, 150.0), 0.2 * 150, rtol=1e-6)
    np.testing.assert_allclose(sigma_of(1e-6, 5e-6, -2.0), [1e-6, 1e-6, 0.4], rtol=1e-6)


def test_a_zero_has_the_geometric_mean_of_the_others():
    np.testing.assert_allclose(sigma_of(0.0, 1.0, 100.0), [2.0, 0.2, 20.0], rtol=1e-6)
    np.testing.assert_allclose(sigma_of(0.0, 0.0), 0.2, rtol=1e-6)


def test_a_parameter_with_a_range_has_a_share_of_that():
    bounds = jnp.array([0.0, -jnp.inf]), jnp.array([10.0, jnp.inf])
    solver = default_solver(jnp.array([1e-3, 50.0]), bounds, None, False)
    np.testing.assert_allclose(solver.sigma, [2.0, 10.0], rtol=1e-6)


def test_residuals_whose_squares_are_no_numbers_are_an_error():
    """At 1e-20 every loss is zero, and a run would have converged at its start; at 1e20 none is."""
    scaled = lambda scale: lambda y: scale * (decay(y) - decay(FOUND))
    for scale in (1e-17, 1e-30):
        with pytest.raises(ValueError, match=r"too small for float32: return them times 1e\+"):
            solved(sd.least_squares, scaled(scale), UNITS)
    with pytest.raises(sd.MinimiseError, match="was too large for float32"):
        solved(sd.least_squares, scaled(1e20), UNITS)
    search = sd.Search(UNITS, key=jax.random.key(0), residuals=True)
    with pytest.raises(ValueError, match="use float64"):
        search.tell(search.ask(), [scaled(1e-20)(UNITS)])


@pytest.mark.slow
def test_squares_that_vanish_are_no_convergence_under_optimistix():
    """There is no error there, as values are traced; residuals that are zero have converged."""
    fit = lambda scale, start: optx.least_squares(
        lambda y, args: scale * (y - 1), SOLVER, start, options=OPTIONS, max_steps=200, throw=False
    )
    found = jax.jit(fit)(jnp.array(1e-24), jnp.zeros(3)).result
    assert found != optx.RESULTS.successful
    assert jax.jit(fit)(jnp.array(1e-24), jnp.ones(3)).result == optx.RESULTS.successful


@pytest.mark.parametrize("unit", quick_of([1e20, 1e30, 1e36, 1e-30], [1e-30]))
def test_a_number_may_be_so_large_that_its_square_is_none(unit):
    """The run ends by itself, as that of an ordinary bowl does."""
    bowl = lambda y, unit: unit * jnp.sum(jnp.array([1.0, 3.0, 2.0]) * (y - 1) ** 2)
    start, key = jnp.array([0.5, 2.0, 1.5]), jax.random.key(0)
    result = sd.minimise(bowl, start, jnp.float32(unit), key=key)
    assert result.reason == "converged"
    np.testing.assert_allclose(result.y, 1, atol=1e-5)


@calls
def test_one_array_may_hold_very_different_units(call):
    residuals = lambda y: decay(y) - decay(FOUND)
    result = solved(call, residuals, UNITS)
    np.testing.assert_allclose(result.y / FOUND, 1, atol=2e-3)


@calls
def test_steps_are_small_in_each_parameter_before_a_run_has_converged(call):
    """Steps of the largest alone would have been small from the beginning."""
    residuals = lambda y: decay(y) - decay(FOUND)
    result = solved(call, residuals, UNITS, sigma=0.1 * UNITS)
    np.testing.assert_allclose(result.y / FOUND, 1, atol=2e-3)


@pytest.mark.slow
@calls
@pytest.mark.parametrize("size", [1e-7, 1e-4])
def test_a_start_far_too_small_is_no_answer(call, size):
    """One sigma away from it, values of float32 hardly differ, or the curvature is rounding."""
    residuals = lambda y: y - jnp.array([1.0, 2.0, 3.0])
    result = solved(call, residuals, jnp.full(3, size))
    assert result.reason == "converged"
    np.testing.assert_allclose(result.y, [1, 2, 3], atol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("size", [1e-6, 1e-4, 1e-2])
def test_a_valley_is_followed_from_there(size):
    valley = lambda y: jnp.stack([10 * (y[1] - y[0] ** 2), 1 - y[0], y[2] - y[1]])
    result = solved(sd.minimise, valley, jnp.full(3, size))
    assert result.fun < 1e-8


@calls
def test_points_that_nobody_chose_may_fail(call):
    """One sigma from the start, and wherever a step is too long, there is no number."""
    wall = lambda y: jnp.where(jnp.all(jnp.abs(y - 1) < 0.1), 30 * (y - 1.05), jnp.nan)
    result = solved(call, wall, jnp.ones(3))
    np.testing.assert_allclose(result.y, 1.05, atol=2e-3)


@calls
def test_a_function_that_always_fails_is_an_error(call):
    """Its NaN are not said to be too large a sum of squares."""
    with pytest.raises(sd.MinimiseError, match="begin where fun is finite") as caught:
        solved(call, lambda y: jnp.full(3, jnp.nan) * y[0], jnp.ones(3))
    assert "float64" not in str(caught.value)


def test_an_infinite_residual_in_float64_is_not_told_to_use_float64(x64):
    with pytest.raises(sd.MinimiseError, match="begin where fun is finite") as caught:
        solved(sd.least_squares, lambda y: jnp.full(3, jnp.inf) * y[0], jnp.ones(3))
    assert "float64" not in str(caught.value)


@pytest.mark.parametrize(("value", "said"), [(1e20, True), (np.nan, False)])
def test_a_batch_says_whether_squares_were_too_large(value, said):
    residuals = lambda y, args: value * (y + 1)
    with pytest.raises(sd.MinimiseError, match="NaN or infinite") as caught:
        sd.least_squares(residuals, jnp.zeros(100), key=jax.random.key(0))
    assert ("too large for float32" in str(caught.value)) == said


@pytest.mark.parametrize("y0", [(0.1, 5.0, 30.0), (2.0, 5.0, 30.0)])
def test_a_barrier_is_no_end(y0):
    barrier = lambda y, args: jnp.sum(y - jnp.log(y))
    result = sd.minimise(barrier, jnp.array(y0), key=jax.random.key(0))
    assert result.reason == "converged"
    np.testing.assert_allclose(result.y, 1, atol=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("place", [0.02, 0.1])
def test_samples_that_fail_come_nearer_to_the_best_point(place):
    """Stairs, which the wide model alone can go down, in a corner of walls.

    Rounding may lead one of many runs to where all around fails.
    """
    stairs = lambda y: jnp.sum(jnp.floor(200 * jnp.abs(y - place)) / 20)
    fun = lambda y, args: jnp.where(jnp.all(y > 0), stairs(y), jnp.nan)

    def lowest(seed):
        try:
            result = sd.minimise(fun, jnp.ones(4), key=jax.random.key(seed), max_evaluations=600)
        except sd.MinimiseError as error:
            return error.result.fun
        return result.fun

    assert sum(lowest(seed) == 0 for seed in range(6)) >= 5


def test_failures_that_go_on_are_an_error():
    """Numbers that came first do not keep a run going that has none any more.

    It would converge after 18 evaluations.
    """
    seen = []

    def fails_later(y):
        seen.append(y)
        return np.float32(np.nan if len(seen) > 10 else np.sum((y - 3) ** 2))

    box = sd.black_box(fails_later, jax.ShapeDtypeStruct((), np.float32), on_nonfinite="nan")
    with pytest.raises(sd.MinimiseError, match="Too few samples were finite"):
        sd.minimise(lambda y, args: box(y), jnp.ones(3), key=jax.random.key(0))


@calls
@pytest.mark.parametrize("size", [8.7e-8, 1e-6])
def test_a_zero_but_for_rounding_is_no_scale(call, size):
    bases = jnp.stack([jnp.exp(-TIMES), TIMES, jnp.cos(9 * TIMES)], axis=1)
    lines = lambda y: jnp.sum(bases * (y - jnp.array([3.0, 2.0, 1.0]))[None], axis=1)
    result = solved(call, lines, jnp.array([1.0, size, 1.0]))
    np.testing.assert_allclose(result.y, [3, 2, 1], atol=5e-3)


def test_a_start_that_is_no_number_is_named():
    with pytest.raises(ValueError, match="nan"):
        solved(sd.minimise, lambda y: y, jnp.array([1.0, jnp.nan]))
    np.testing.assert_allclose(sigma_of(1.0, 1e-40), 0.2, rtol=1e-6)


def test_parameters_that_change_nothing_stay_where_they_were():
    one_of_three = lambda y, args: (y[0] - 3) ** 2 + 1
    result = sd.minimise(one_of_three, jnp.ones(3), key=jax.random.key(0))
    np.testing.assert_allclose(result.y[0], 3, atol=2e-3)
    np.testing.assert_array_equal(result.y[1:], 1)


def test_a_parameter_may_change_nothing_at_the_start_alone():
    hidden = lambda y, args: (y[0] - 3) ** 2 + jnp.where(y[0] > 2, (y[1] - 5) ** 2, 30.0)
    result = sd.minimise(hidden, jnp.ones(2), key=jax.random.key(0))
    np.testing.assert_allclose(result.y, [3, 5], atol=5e-3)


@pytest.mark.parametrize("n", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_a_bowl_ends_soon_where_rounding_is_all_that_is_left(n):
    """There steps fail that are no longer than the rounding of the parameters."""
    result = sd.minimise(lambda y, args: jnp.sum((y - 3) ** 2), jnp.ones(n), key=jax.random.key(0))
    assert result.reason == "converged"
    assert result.evaluations < 25


@pytest.mark.slow
def test_a_bottom_that_is_flat_to_rounding_is_not_left():
    """The radius grew without end where each check rose, but not as predicted."""
    seen = []

    def quartic(y):
        seen.append(float(y[0]))
        return np.float32(np.sum((y - 0.3) ** 4) + 0.01 * np.sum((y - 0.3) ** 2) - 7)

    box = sd.black_box(quartic, jnp.float32(0))
    fun = lambda y, args: box(y)
    result = sd.minimise(fun, jnp.ones(1), key=jax.random.key(0), max_evaluations=130)
    np.testing.assert_allclose(result.y, 0.3, atol=0.02)
    assert np.max(np.abs(seen)) < 100


ENDS = [(1, 0), (1, 2), (2, 3), (5, 0), (5, 1), (5, 2)]


@pytest.mark.parametrize("case", quick_of(ENDS, ENDS[:1]), ids=str)
def test_a_quadratic_ends_soon_after_its_minimum(x64, case):
    """Points of a check lie so near that others seem to be outliers."""
    n, seed = case
    numbers = np.random.default_rng(seed)
    bend = jnp.asarray(numbers.standard_normal((n, n)) + 2 * np.eye(n))
    best, lowest = jnp.asarray(numbers.standard_normal(n)), [0, 1, -300][seed % 3]
    fun = lambda y, args: jnp.sum((bend @ (y - best)) ** 2) + lowest
    result = sd.minimise(fun, jnp.ones(n), key=jax.random.key(seed))
    found = next(r.evaluations for r in result.history if r.fun < lowest + 1e-9)
    assert result.reason == "converged"
    assert result.evaluations < found + 20


@pytest.mark.slow
@calls
def test_a_parameter_that_came_nearer_as_it_failed_goes_no_farther(call):
    """It changes nothing within 0.05, and fails beyond: one step of the other finds the answer."""
    fails = lambda y: jnp.where(jnp.abs(y[1]) > 0.05, jnp.nan, y[:1] - 3)
    result = solved(call, fails, jnp.array([1.0, 0.0]), sigma=1.0)
    np.testing.assert_allclose(result.y, [3, 0], atol=5e-3)
