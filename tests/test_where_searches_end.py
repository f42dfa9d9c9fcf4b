"""Where a search ends: at no minimum of a ripple, and soon after nothing is left but rounding."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import smoothdiff as sd
from smoothdiff._params import take_apart
from smoothdiff._solvers._ratio_test import is_lower, rounding_alone
from tests.parts import quick_of

PIXELS = np.linspace(0, 1, 32)


def rippled(y, args):
    """A bump that should be at 0.3, under ripples of a five-hundredth that fade out there."""
    bump = lambda at: jnp.exp(-(((PIXELS.astype(y.dtype) - at) / 0.2) ** 2))
    ripples = jnp.sin(3e3 * y + 40 * PIXELS.astype(y.dtype)) * jnp.abs(y - 0.3)
    return bump(y) - bump(0.3) + 0.5 * ripples


@pytest.mark.parametrize("seed", quick_of(range(8), [4]))
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
@pytest.mark.parametrize("seed", range(3))
def test_a_search_at_a_minimum_makes_room_for_others(seed, x64):
    rng = np.random.default_rng(0)
    wells = rng.uniform(-4, 4, (12, 2)), rng.uniform(2, 8, 12), rng.uniform(0.5, 1.2, 12)
    result = sd.minimise(
        peaks,
        jnp.array([3.5, -3.5]),
        tuple(map(jnp.asarray, wells)),
        solver=sd.NewtonCG(1.0, restarts=100),
        key=jax.random.key(seed),
        bounds=(-4.0, 4.0),
        max_evaluations=600,
    )
    # each of them goes to the last digit of its well
    assert int(result.state.search.searches) >= 5


def test_rounding_alone_is_more_values_than_levels(dtype):
    eps = float(jnp.finfo(dtype).eps)
    said = lambda funs, width: bool(
        rounding_alone(jnp.asarray(funs, dtype), jnp.ones(len(funs), bool), jnp.asarray(width))
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
        some = jnp.arange(5) < left
        assert not rounding_alone(jnp.asarray(levels, dtype), some, jnp.asarray(1e-6))
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
