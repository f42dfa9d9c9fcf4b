"""The lowest of the points at which a function was evaluated."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree


class Seen(NamedTuple):
    """A point, the function there, finite or not, and its aux; or several of them, stacked."""

    point: PyTree[Array]
    value: Array
    aux: PyTree[Array] = None

    def lowest(self) -> "Seen":
        """Of several the lowest, whose value is infinite if none is finite; the aux of the first.

        Some aux has to do for solvers that never evaluate the iterate.
        """
        point, value = lowest(self.point, self.value)
        return Seen(point, value, jax.tree.map(lambda a: a[0], self.aux))


def lowest(points: PyTree[Array], values: Float[Array, " m"]) -> tuple[PyTree[Array], Array]:
    """The point with the lowest value, and that value; infinity if none is finite."""
    values = jnp.where(jnp.isfinite(values), values, jnp.inf)
    at = jnp.argmin(values)
    return jax.tree.map(lambda a: a[at], points), values[at]


def kept(points: PyTree[Array]) -> PyTree[Array]:
    """The same points, divided by one, which does not change a bit.

    XLA may compute a point once for the function and once more for who remembers it, and rounds
    otherwise there; a division it does not repeat. So what is returned is what was evaluated.
    """
    return jax.tree.map(lambda a: a / jnp.where(a == a, 1, 2).astype(a.dtype), points)


def watched(fn: Callable, args: Any) -> Callable[[PyTree], tuple[Array, Seen]]:
    """The function of y alone with `Seen` as its aux, of which `evaluate` keeps the lowest."""

    def seen(y: PyTree) -> tuple[Array, Seen]:
        y = kept(y)
        value, aux = fn(y, args)
        return value, Seen(y, value, aux)

    return seen
