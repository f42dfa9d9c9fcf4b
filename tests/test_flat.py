"""A pytree as a tuple of its arrays."""

import jax
import jax.numpy as jnp
import numpy as np

import smoothdiff as sd
from smoothdiff._flat import Flat

TREE = {"solver": sd.NewtonCG(0.3), "y": (jnp.ones(2), None, np.arange(3)), "name": "drop"}


def test_it_is_the_same_pytree_after_it():
    flat = Flat.of(TREE)
    assert all(isinstance(leaf, jax.Array | np.ndarray) for leaf in jax.tree.leaves(flat))
    back = flat.tree()
    assert jax.tree.structure(back) == jax.tree.structure(TREE)
    assert (back["name"], back["solver"]) == ("drop", TREE["solver"])
    np.testing.assert_array_equal(back["y"][2], TREE["y"][2])


def test_programs_are_compiled_once_for_the_same_rest():
    traces = []

    @jax.jit
    def twice(flat):
        traces.append(flat)
        tree = flat.tree()
        return Flat.of(tree | {"y": jax.tree.map(lambda a: 2 * a, tree["y"])})

    once = twice(Flat.of(TREE))
    for _ in range(2):
        once = twice(once)
    assert len(traces) == 1
    np.testing.assert_array_equal(once.tree()["y"][0], 8)
    twice(Flat.of(TREE | {"name": "propagate"}))
    assert len(traces) == 2
