"""What a case states and what it saw, and the few words that all cases share."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from jaxtyping import Array, Float

import smoothdiff as sd

DTYPES = ("float32", "float64")
BASELINES = ("mean", "gp", "quadratic")


class Check(NamedTuple):
    """One number that must be at most its limit; NaN is not."""

    what: str
    unit: str
    limit: float
    seen: float

    @property
    def holds(self) -> bool:
        return bool(self.seen <= self.limit)


def precision(dtype: str) -> Any:
    """The context in which arrays of this type exist."""
    return jax.enable_x64(dtype == "float64")


def rms(x: Any) -> float:
    return float(np.sqrt(np.mean(np.square(np.asarray(x, np.float64)))))


def relative(found: Any, exact: Any) -> float:
    """The largest error relative to the largest exact entry, the worst over the leaves."""

    def leaf(found: Any, exact: Any) -> float:
        found, exact = np.asarray(found, np.float64), np.asarray(exact, np.float64)
        return float(np.max(np.abs(found - exact)) / np.max(np.abs(exact)))

    return max(jax.tree.leaves(jax.tree.map(leaf, found, exact)))


def derivatives(fun: Callable, sigma: Any, **options: Any) -> Callable:
    """`g(key, x) -> {gradient, Hessian}` of a function of one vector, from one batch."""

    def g(key: Any, x: Float[Array, " n"], *args: Any) -> dict[str, Array]:
        model = sd.smooth_quadratic(fun, sigma, **options)(key, x, *args)
        return {"gradient": model.grad, "Hessian": model.hessian.as_matrix()}

    return g


def exact_derivatives(smoothed: Callable) -> Callable:
    """The same by AD of a closed form."""
    return lambda x: {"gradient": jax.grad(smoothed)(x), "Hessian": jax.hessian(smoothed)(x)}


def edge_and_waves(x: Float[Array, " n"]) -> Float[Array, ""]:
    """A hard edge over a smooth landscape, in any number of dimensions."""
    return (jnp.sum(x) > 0).astype(x.dtype) + jnp.mean(jnp.sin(x))


def smoothed_edge_and_waves(theta: Float[Array, " n"]) -> Float[Array, ""]:
    """Its smoothed value for sigma = 1."""
    edge = ndtr(jnp.sum(theta) / np.sqrt(theta.size).astype(theta.dtype))
    return edge + jnp.exp(-jnp.ones((), theta.dtype) / 2) * jnp.mean(jnp.sin(theta))
