"""`Flat` and `Packed`: a pytree as programs take it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import smoothdiff as sd
from smoothdiff._flat import Flat
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
kinds = pytest.mark.parametrize("kind", [Flat, Packed])


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


@kinds
def test_a_pytree_comes_back_as_it_was(kind):
    same(kind.of(TREE).tree(), TREE)
    same(jax.jit(lambda packed: kind.of(packed.tree()))(kind.of(TREE)).tree(), TREE)


@kinds
@pytest.mark.parametrize("tree", [{}, None, {"name": "drop"}, jnp.ones(2), jnp.ones(())], ids=str)
def test_a_tree_may_have_no_scalars_or_nothing_else(kind, tree):
    same(kind.of(tree).tree(), tree)


@kinds
def test_all_that_varies_is_an_array(kind):
    leaves = jax.tree.leaves(kind.of(TREE))
    assert all(isinstance(leaf, jax.Array | np.ndarray | np.generic) for leaf in leaves)


def test_a_program_has_one_array_for_the_scalars_of_a_dtype():
    scalars = {name: jnp.asarray(i, jnp.float32) for i, name in enumerate("abcdef")}
    whole = {name.upper(): jnp.asarray(i, jnp.int32) for i, name in enumerate("abc")}
    assert len(jax.tree.leaves(Packed.of(scalars | whole))) == 2


def test_scalars_may_be_numpy_s():
    packed = jax.jit(lambda packed: packed)(Packed.of(TREE))
    on_host = packed.on_host()
    same(on_host.tree(), TREE)
    assert not isinstance(on_host.tree()["count"], jax.Array)
    assert not any(isinstance(scalars, jax.Array) for scalars in on_host.scalars)


@kinds
def test_float64_is_kept(kind, x64):
    tree = {"a": jnp.asarray(1 / 3, jnp.float64), "b": jnp.asarray(1 / 3, jnp.float32)}
    same(jax.jit(lambda packed: kind.of(packed.tree()))(kind.of(tree)).tree(), tree)


@kinds
def test_programs_are_compiled_once_for_the_same_rest(kind):
    traces = []

    @jax.jit
    def step(packed):
        traces.append(packed)
        tree = packed.tree()
        return kind.of(tree | {"count": tree["count"] + 1})

    once = step(kind.of(TREE))
    for _ in range(2):
        once = step(kind.of(once.tree()))
    assert len(traces) == 1
    assert once.tree()["count"] == 6
    step(kind.of(TREE | {"name": "propagate"}))
    assert len(traces) == 2


@kinds
def test_it_may_be_vmapped(kind):
    tree = {"a": jnp.arange(3.0), "b": jnp.arange(3, dtype=jnp.int32)}
    double = lambda tree: jax.tree.map(lambda a: 2 * a, kind.of(tree).tree())
    same(jax.vmap(double)(tree), double(tree))
