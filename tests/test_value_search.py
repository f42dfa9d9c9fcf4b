"""The search for the minimum of one number: what one model leaves to the other."""

import dataclasses
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from smoothdiff._params import take_apart
from smoothdiff._solvers._history import History
from smoothdiff._solvers._stages import TRUST, WIDE, Sizes
from smoothdiff._solvers._value_search import ValueSearch

N = 2
PARAMS = take_apart(jnp.zeros(N), jnp.ones(N), None)
SIZES = Sizes(step=1, first=4, later=4, patience=60)
RADIUS, WIDTH = 1e-3, 0.7


def begun(points, values, width):
    """A search at the origin that knows these values."""
    history = History.empty(40, N, 1, jnp.float32)
    for point, value in zip(points, values, strict=True):
        row = jnp.full((1, 1), value)
        new = jnp.asarray(point, jnp.float32)[None], row, row[0], jnp.ones(1, bool)
        history = history.after(*new, jnp.asarray(1))
    first = ValueSearch.of(PARAMS, jnp.zeros(N), jnp.asarray(width), history)
    return cast(ValueSearch, first)


@jax.jit
def after_wide_samples(found, fun):
    """The search once the wide model's turn is over, in which it found this lowest point.

    The local model was at the origin, with a small radius, but had not failed.
    """
    search = begun([np.zeros(N), found], [1.0, fun], WIDTH)
    trust = dataclasses.replace(search.trust, radius=jnp.asarray(RADIUS))
    turn = dataclasses.replace(search.turn, before=jnp.asarray(1.0), spent=search.turn.length)
    stage = jnp.asarray(WIDE, jnp.int32)
    search = dataclasses.replace(search, stage=stage, trust=trust, turn=turn)
    return search._turned(PARAMS, SIZES)


@pytest.mark.parametrize(
    ("found", "fun", "radius"),
    [
        ([0.5, 0.0], 0.5, WIDTH),
        ([RADIUS / 2, 0.0], 0.99, RADIUS),
        ([0.5, 0.0], 1.5, RADIUS),
    ],
    ids=["elsewhere", "near", "nothing lower"],
)
def test_a_radius_is_that_of_the_place_where_the_model_was(found, fun, radius):
    search = after_wide_samples(np.array(found, np.float32), fun)
    assert search.stage == TRUST
    assert search.trust.radius == pytest.approx(radius)


def parabola(x):
    """Lowest at -0.1."""
    return 3 + 5 * (x + 0.1) ** 2


@pytest.mark.parametrize(
    ("places", "near"),
    [
        ([1, -1], 0.4),
        ([1, -0.5], 0.4),
        ([1], 1),
        ([1, -0.15], 1),
        ([0.3, -0.3], 1),
        ([9, -9], 0.25),
    ],
    ids=["both", "one shorter, as bounds may have it", "one alone", "one lower", "near", "far"],
)
@pytest.mark.parametrize("above", [1.0, 1e30])
def test_first_points_should_be_four_times_as_far_as_the_lowest(places, near, above):
    points = [np.zeros(N), *([place, 0.0] for place in places)]
    search = begun(points, [above * parabola(point[0]) for point in points], 1.0)
    np.testing.assert_allclose(search.nearer(), [near, 1], rtol=1e-3)


def test_where_the_start_failed_nothing_says_that_points_should_be_nearer():
    points = np.array([[1.0, 0.0], [-1.0, 0.0]])
    search = begun(points, [parabola(point[0]) for point in points], 1.0)
    np.testing.assert_array_equal(search.nearer(), 1)
