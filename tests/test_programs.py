"""What is compiled quickly, and how: short programs, however long a host function takes."""

import jax
import jax.numpy as jnp
import pytest

import smoothdiff as sd
from smoothdiff import _programs
from smoothdiff._devices import default_platform
from smoothdiff._programs import is_short, jit_quickly

BOX = sd.black_box(lambda y: y, jax.ShapeDtypeStruct((10,), jnp.float32))
PICTURE = jnp.zeros((400, 400))


@jax.jit
def inside(y):
    return jnp.sum(jnp.sin(PICTURE) * y[0])


SHORT = {
    "a sum": lambda y: jnp.sum(y**2),
    "a host function": lambda y: jnp.sum(BOX(y) ** 2),
    "a switch": lambda y: jax.lax.cond(y[0] > 0, jnp.sin, jnp.cos, y),
}
LONG = {
    "a picture": lambda y: jnp.sum(jnp.sin(PICTURE) * y[0]),
    "a picture in another program": inside,
    "a picture in a branch": lambda y: jax.lax.cond(y[0] > 0, inside, jnp.sum, y),
    "a large matrix": lambda y: PICTURE[:10].T @ y,
    "many lines": lambda y: sum(jnp.sin(i * y) for i in range(5_000)),
    "a loop": lambda y: jax.lax.fori_loop(0, 9, lambda i, y: y + 1, y),
    "a loop that ends by itself": lambda y: jax.lax.while_loop(lambda y: y[0] < 9, jnp.exp, y),
    "batches": lambda y: jax.lax.map(jnp.sin, y, batch_size=2),
}


@pytest.mark.parametrize("name", SHORT)
def test_few_numbers_are_short_on_the_cpu_alone(name):
    program = jax.make_jaxpr(SHORT[name])(jnp.ones(10))
    assert is_short(program) == (default_platform() == "cpu")
    assert not is_short(program, times=100_000)


@pytest.mark.parametrize("name", LONG)
def test_many_numbers_and_loops_are_not(name):
    assert not is_short(jax.make_jaxpr(LONG[name])(jnp.ones(10)))


def test_options_that_this_xla_does_not_know_are_left_out(monkeypatch):
    _programs._quickly.cache_clear()
    known = _programs._OLDER
    monkeypatch.setattr(_programs, "_OLDER", known | {"xla_of_another_version": 1})
    double = jit_quickly(lambda x, times: times * x, static_argnums=1)
    assert double(jnp.ones(2), 2).tolist() == [2, 2]
    assert _programs._quickly().keys() <= {"xla_backend_optimization_level", *known}
    _programs._quickly.cache_clear()
