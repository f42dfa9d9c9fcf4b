"""What a case states and what it saw, and the few words that all cases share."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from jaxtyping import Array, Float

import smoothdiff as sd

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


def precisions(single: float = 0, double: float = 0) -> Iterator[tuple[str, float]]:
    """Each type of numbers with its limit; until the next one, arrays of this type exist."""
    for dtype, limit in ("float32", single), ("float64", double):
        with jax.enable_x64(dtype == "float64"):
            yield dtype, limit


def rms(x: Any) -> float:
    return float(np.sqrt(np.mean(np.square(np.asarray(x, np.float64)))))


def relative(found: Any, exact: Any) -> float:
    """The largest error relative to the largest exact entry, the worst over the leaves."""

    def leaf(found: Any, exact: Any) -> float:
        found, exact = np.asarray(found, np.float64), np.asarray(exact, np.float64)
        return float(np.max(np.abs(found - exact)) / np.max(np.abs(exact)))

    return max(jax.tree.leaves(jax.tree.map(leaf, found, exact)))


def alike(what: str, limit: float, found: dict, exact: dict) -> Iterator[Check]:
    """A check of the relative error of each derivative."""
    for name in exact:
        seen = relative(found[name], exact[name])
        yield Check(f"{what}, {name}", "relative error", limit, seen)


def derivatives(fun: Callable, sigma: Any, **options: Any) -> Callable:
    """`g(key, x) -> {gradient, Hessian}` of a function of one vector, from one batch."""

    def g(key: Any, x: Float[Array, " n"], *args: Any) -> dict[str, Array]:
        model = sd.smooth_quadratic(fun, sigma, **options)(key, x, *args)
        return {"gradient": model.grad, "Hessian": model.hessian.as_matrix()}

    return g


def in_widths(found: dict, sigma: Any) -> dict[str, np.ndarray]:
    """Derivatives in parameters that are in units of their width."""
    gradient, hessian, sigma = (
        np.asarray(each, np.float64) for each in (found["gradient"], found["Hessian"], sigma)
    )
    return {"gradient": gradient * sigma, "Hessian": hessian * np.outer(sigma, sigma)}


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
