"""Surrogates: their shapes, closed forms and initial weights."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from smoothdiff.surrogates import MLP, Quadratic, select

KEY = jax.random.key(3)


def weights(surrogate):
    return jax.tree.leaves(eqx.filter(surrogate, eqx.is_array))


@pytest.mark.parametrize("size", [1, 60])
@pytest.mark.parametrize("make", [MLP, Quadratic])
def test_a_point_gives_one_number_and_a_gradient(make, size):
    at_point = lambda u: jax.value_and_grad(make(size, key=KEY))(u)
    value, grad = jax.jit(at_point)(np.linspace(0.1, 1, size).astype(np.float32))
    assert value.shape == ()
    assert grad.shape == (size,)
    assert np.any(np.asarray(grad) != 0)


def test_the_positional_encoding_adds_octaves():
    @jax.jit
    def both(u):
        surrogate = MLP(3, width=5, depth=1, frequencies=2, key=KEY)
        features = [u, jnp.sin(u), jnp.sin(2 * u), jnp.cos(u), jnp.cos(2 * u)]
        assert surrogate.layers.layers[0].weight.shape == (5, 15)
        return surrogate(u), surrogate.layers(jnp.concatenate(features))

    np.testing.assert_allclose(*both(jnp.array([0.1, 0.2, 0.3])), rtol=1e-6)


def test_only_a_smooth_activation_has_curvature():
    """And so does the default, whose curvature the solver and `newton_step` use."""
    both = MLP(2, activation=jax.nn.leaky_relu, key=KEY), MLP(2, key=KEY)
    rectified, smooth = jax.jit(lambda u: [jax.hessian(each)(u) for each in both])(
        jnp.array([0.3, -0.2])
    )
    np.testing.assert_array_equal(rectified, 0)
    assert np.any(np.asarray(smooth) != 0)


def test_the_quadratic_starts_as_the_identity_and_has_the_curvature_of_its_matrix():
    quadratic = Quadratic(2, key=KEY)
    assert quadratic(jnp.array([1.0, 2.0])) == 1 + 4 + 1
    matrix = jnp.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]])
    quadratic = eqx.tree_at(lambda q: q.matrix, quadratic, matrix)
    u = jnp.array([0.5, -1.0])
    assert quadratic(u) == jnp.append(u, 1) @ matrix @ jnp.append(u, 1)
    np.testing.assert_allclose(jax.jit(jax.hessian(quadratic))(u), (matrix + matrix.T)[:2, :2])


def test_keys_draw_the_weights():
    same = [weights(MLP(4, key=jax.random.key(i))) for i in (0, 0, 1)]
    np.testing.assert_array_equal(same[0][0], same[1][0])
    assert not jnp.array_equal(same[0][0], same[2][0])


# the choice by held-out error


def linear(size, *, key):
    return eqx.nn.Linear(size, "scalar", key=key)


CANDIDATES = [linear, functools.partial(MLP, width=32, depth=1, activation=jnp.tanh)]
POINTS = jax.random.normal(jax.random.key(7), (300, 2))


def test_a_linear_function_needs_the_smallest():
    noise = 0.3 * jax.random.normal(jax.random.key(8), (300,))
    values = 100 + POINTS @ jnp.array([1.0, -2.0]) + noise
    selection = select(CANDIDATES, POINTS, values, key=KEY)
    assert selection.surrogate is linear
    # what is left is the noise's share of the variance
    share = 0.09 / (5 + 0.09)
    assert abs(selection.errors[0] - share) < 4 * selection.stderrs[0]


def test_a_wiggly_one_needs_more():
    values = jnp.sin(2 * POINTS[:, 0]) * jnp.cos(POINTS[:, 1])
    selection = select(CANDIDATES, POINTS, values, key=KEY)
    assert selection.surrogate is CANDIDATES[1]
    assert selection.errors[1] < 0.5 * selection.errors[0]


def test_any_module_is_a_candidate():
    curved = jnp.sum(POINTS**2, axis=1)
    selection = select([linear, Quadratic], POINTS, curved, key=KEY, steps=2000)
    assert selection.surrogate is Quadratic
    assert selection.errors[1] < 1e-2


@pytest.mark.parametrize(
    ("candidates", "values", "settings", "match"),
    [
        ([], jnp.ones(300), {}, "at least one"),
        (CANDIDATES, jnp.ones(299), {}, "one value for each"),
        (CANDIDATES, jnp.ones(300).at[3].set(jnp.nan), {}, "finite"),
        (CANDIDATES, jnp.ones((300, 1)), {}, r"values a number, not .*\(300, 1\)"),
        (CANDIDATES, jnp.ones(300), {"held_out": 0.0}, "held_out"),
        (CANDIDATES, jnp.ones(300), {"held_out": 1.0}, "held_out"),
    ],
    ids=["none", "lengths", "nan", "column", "nothing held out", "all held out"],
)
def test_what_cannot_be_compared_is_refused(candidates, values, settings, match):
    with pytest.raises(ValueError, match=match):
        select(candidates, POINTS, values, key=KEY, **settings)


def test_points_are_finite_rows_and_may_be_lists():
    values = jnp.sum(POINTS**2, axis=1)
    with pytest.raises(ValueError, match="points and values must be finite"):
        select([Quadratic], POINTS.at[0, 0].set(jnp.nan), values, key=KEY, steps=10)
    with pytest.raises(ValueError, match="a row for each point"):
        select([Quadratic], POINTS[:, 0], values, key=KEY, steps=10)
    settings: dict = {"key": KEY, "steps": 10}
    given: Any = POINTS.tolist(), values.tolist()
    lists = select([Quadratic], *given, **settings)
    np.testing.assert_allclose(
        lists.errors, select([Quadratic], POINTS, values, **settings).errors, rtol=1e-4
    )
