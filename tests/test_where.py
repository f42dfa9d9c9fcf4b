"""Choices between two states of a search."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from smoothdiff._solvers._where import where


class State(NamedTuple):
    at: object
    found: object
    shared: object


def states(module):
    shared = module.arange(3)
    one = State(module.asarray(1.0, "float32"), None, shared)
    return one, State(module.asarray(2.0, "float32"), None, shared)


@pytest.mark.parametrize("module", [jnp, np], ids=["jax", "numpy"])
@pytest.mark.parametrize("condition", [True, False])
def test_one_of_two_is_chosen_and_what_they_share_is_kept(module, condition):
    a, b = states(module)
    chosen = where(jnp.asarray(condition), a, b)
    assert chosen.at == (a if condition else b).at
    assert chosen.at.dtype == jnp.float32
    assert chosen.found is None
    assert chosen.shared is a.shared


def test_each_run_of_many_has_its_own_condition():
    a, b = states(jnp)
    conditions = jnp.array([True, False, True])
    chosen = jax.jit(jax.vmap(lambda condition: where(condition, a, b)))(conditions)
    np.testing.assert_array_equal(chosen.at, [1.0, 2.0, 1.0])
    assert chosen.shared.shape == (3, 3)


def test_both_have_the_same_dtypes(x64):
    with pytest.raises(TypeError, match="float64"):
        where(jnp.asarray(True), (jnp.ones(2, "float32"),), (jnp.ones(2, "float64"),))
