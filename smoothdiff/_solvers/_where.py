"""The choice between two states: one branch for all of their arrays."""

from typing import Any

import equinox as eqx
import jax
from jaxtyping import Array, Bool, PyTree


def where(condition: Bool[Array, ""], a: Any, b: Any) -> Any:
    """One of two pytrees of the same shapes and dtypes.

    What is the same in both, such as the history, is not copied.
    """
    differ = jax.tree.map(lambda a, b: a is not b, a, b)
    (a, same), (b, _) = eqx.partition(a, differ), eqx.partition(b, differ)
    return eqx.combine(_either(condition, a, b), same)


@jax.jit
def _either(condition: Bool[Array, ""], a: PyTree[Array], b: PyTree[Array]) -> PyTree[Array]:
    """A branch chooses all arrays at once.

    With a `jnp.where` for each, XLA computes anew for each what leads to the condition.
    """
    return jax.lax.cond(condition, lambda: a, lambda: b)
