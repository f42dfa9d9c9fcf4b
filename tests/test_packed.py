"""A pytree whose scalars are in one array for each dtype."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import smoothdiff as sd
from smoothdiff._packed import Packed

TREE = {
    "count": jnp.asarray(3, jnp.int32),
    "key": jax.random.key(1),
    "last": jnp.asarray(7, jnp.int32),
    "name": "drop",
    "over": jnp.asarray(True),
    "solver": sd.NewtonCG(jnp.asarray(0.3)),
    "y": (jnp.ones(2), None, np.float32(np.inf)),
}


def same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        if isinstance(one, jax.Array | np.ndarray | np.generic):
            assert (one.shape, one.dtype) == (other.shape, other.dtype)
            if isinstance(one, jax.Array) and jnp.issubdtype(one.dtype, jax.dtypes.prng_key):
                one, other = jax.random.key_data(one), jax.random.key_data(other)
            np.testing.assert_array_equal(one, other)
        else:
            assert one == other


def test_a_pytree_comes_back_as_it_was():
    same(Packed.of(TREE).tree(), TREE)
    same(jax.jit(lambda packed: Packed.of(packed.tree()))(Packed.of(TREE)).tree(), TREE)


@pytest.mark.parametrize("tree", [{}, None, {"name": "drop"}, jnp.ones(2), jnp.ones(())], ids=str)
def test_a_tree_may_have_no_scalars_or_nothing_else(tree):
    same(Packed.of(tree).tree(), tree)


def test_a_program_has_one_array_for_the_scalars_of_a_dtype():
    scalars = {name: jnp.asarray(i, jnp.float32) for i, name in enumerate("abcdef")}
    whole = {name.upper(): jnp.asarray(i, jnp.int32) for i, name in enumerate("abc")}
    assert len(jax.tree.leaves(Packed.of(scalars | whole))) == 2


def test_float64_is_kept(x64):
    tree = {"a": jnp.asarray(1 / 3, jnp.float64), "b": jnp.asarray(1 / 3, jnp.float32)}
    same(jax.jit(lambda packed: Packed.of(packed.tree()))(Packed.of(tree)).tree(), tree)


def test_programs_are_compiled_once_for_the_same_rest():
    traces = []

    @jax.jit
    def step(packed):
        traces.append(packed)
        tree = packed.tree()
        return Packed.of(tree | {"count": tree["count"] + 1})

    once = step(Packed.of(TREE))
    for _ in range(2):
        once = step(Packed.of(once.tree()))
    assert len(traces) == 1
    assert once.tree()["count"] == 6
    step(Packed.of(TREE | {"name": "propagate"}))
    assert len(traces) == 2


def test_it_may_be_vmapped():
    tree = {"a": jnp.arange(3.0), "b": jnp.arange(3, dtype=jnp.int32)}
    double = lambda tree: jax.tree.map(lambda a: 2 * a, Packed.of(tree).tree())
    same(jax.vmap(double)(tree), double(tree))
