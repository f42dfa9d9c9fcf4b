"""Newton steps on a surrogate: exact where they can be, within the radius elsewhere."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest

import smoothdiff as sd
from smoothdiff.surrogates import MLP, Quadratic

KEY = jax.random.key(5)
MATRIX = jnp.array([[4.0, 1.0], [1.0, 0.5]])
LOWEST = jnp.array([0.6, -0.4])


def bowl(y):
    return (y - LOWEST) @ MATRIX @ (y - LOWEST)


def stepped(fun, y, radius) -> Any:
    optim = sd.newton_step(radius)
    grad, state = jax.grad(fun)(y), optim.init(y)
    updates, _ = jax.jit(lambda g, y: optim.update(g, state, y, value_fn=fun))(grad, y)
    return optax.apply_updates(y, updates)


def test_one_step_solves_a_quadratic(dtype):
    fun = lambda y: bowl(y.astype(jnp.float32)).astype(dtype) if dtype == jnp.float32 else bowl64(y)

    def bowl64(y):
        left = y - LOWEST.astype(dtype)
        return left @ MATRIX.astype(dtype) @ left

    y = stepped(fun, jnp.zeros(2, dtype), radius=10.0)
    assert y.dtype == dtype
    np.testing.assert_allclose(y, LOWEST, atol=1e-5)


def test_one_step_solves_a_quadratic_surrogate():
    matrix = jnp.array([[2.0, 0.5, 1.0], [0.5, 1.0, -1.0], [1.0, -1.0, 3.0]])
    quadratic = Quadratic(2, key=KEY)
    surrogate = lambda u: jnp.append(u, 1) @ matrix @ jnp.append(u, 1)
    assert quadratic(jnp.zeros(2)) == 1
    y = stepped(surrogate, jnp.zeros(2), radius=10.0)
    np.testing.assert_allclose(jax.grad(surrogate)(y), 0, atol=1e-4)


def test_the_radius_has_the_units_of_each_leaf():
    fun = lambda y: bowl(jnp.stack([y["a"], y["b"] / 100]))
    y = {"a": jnp.float32(0.0), "b": jnp.float32(0.0)}
    far = stepped(fun, y, {"a": 0.01, "b": 1.0})
    plain = stepped(bowl, jnp.zeros(2), 0.01)
    np.testing.assert_allclose([far["a"], far["b"] / 100], plain, rtol=1e-4)
    np.testing.assert_allclose(jnp.linalg.norm(plain), 0.01, rtol=1e-4)


@pytest.mark.parametrize("fun", [lambda y: -jnp.sum((y - 0.1) ** 2), lambda y: y[0] - y[1] ** 2])
def test_negative_curvature_leads_down_to_the_radius(fun):
    y0 = jnp.zeros(2)
    y = stepped(fun, y0, 0.5)
    np.testing.assert_allclose(jnp.linalg.norm(y), 0.5, rtol=1e-4)
    assert fun(y) < fun(y0)


@pytest.mark.slow
def test_zerograds_descends_by_it():
    solver = sd.ZeroGrads(
        0.3,
        surrogate=functools.partial(MLP, width=16, depth=1, activation=jax.nn.gelu),
        surrogate_optimizer=optax.adam(0.01),
        optimizer=sd.newton_step(0.03),
    )
    fun = lambda y, args: jnp.sum(jnp.floor(8 * jnp.abs(y - LOWEST)))
    solution = optx.minimise(
        fun, solver, jnp.zeros(2), options={"key": KEY}, max_steps=200, throw=False
    )
    np.testing.assert_allclose(solution.value, LOWEST, atol=0.15)


def test_bad_input():
    with pytest.raises(ValueError, match="positive"):
        sd.newton_step(-1.0)
    with pytest.raises(ValueError, match="value_fn"):
        sd.newton_step(1.0).update(jnp.zeros(2), optax.EmptyState(), jnp.zeros(2))


def test_the_radius_may_be_traced():
    optim = optax.inject_hyperparams(sd.newton_step)(radius=0.5)
    y = jnp.zeros(2)
    state: Any = optim.init(y)

    @jax.jit
    def step(radius):
        hyperparams = state.hyperparams | {"radius": radius}
        grad, now = jax.grad(bowl)(y), state._replace(hyperparams=hyperparams)
        return optim.update(grad, now, y, value_fn=bowl)[0]

    np.testing.assert_allclose(y + step(0.5), stepped(bowl, y, 0.5), rtol=1e-6)
    assert np.all(np.isnan(step(-0.5)))
