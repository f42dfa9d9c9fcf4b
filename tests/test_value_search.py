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


@jax.jit
def after_wide_samples(found, fun):
    """The search once the wide model's turn is over, in which it found this lowest point.

    The local model was at the origin, with a small radius, but had not failed.
    """
    history = History.empty(40, N, 1, jnp.float32)
    for point, value in [(np.zeros(N), 1.0), (found, fun)]:
        row = jnp.full((1, 1), value)
        new = jnp.asarray(point, jnp.float32)[None], row, row[0], jnp.ones(1, bool)
        history = history.after(*new, jnp.asarray(1))
    first = ValueSearch.of(PARAMS, jnp.zeros(N), jnp.asarray(WIDTH), history)
    search = cast(ValueSearch, first)
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
