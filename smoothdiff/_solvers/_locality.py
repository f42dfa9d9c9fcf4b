"""Where ZeroGrads samples: points around the parameters, and the function nearby, smoothed."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from smoothdiff._batch import Batch, evaluate
from smoothdiff._estimate import combine
from smoothdiff._named_baselines import as_baseline
from smoothdiff._params import Params, is_concrete, take_apart
from smoothdiff._samplers import AbstractSampler
from smoothdiff._stderr import value_stderr

# the width of the smoothing kernel, in units of that of the locality
_INNER = 0.15


@dataclass(frozen=True)
class Locality:
    """The two kernels of a step: sigma around the parameters, and `inner`, which smooths."""

    params: Params
    inner: Float[Array, " n"]
    key: Array
    sampler: AbstractSampler
    num_samples: int
    nonfinite: Literal["propagate", "drop"]
    local: bool  # False: points are anywhere within the bounds

    def around(self, fun: Callable[[PyTree], Any]) -> tuple[Array, Batch]:
        """Points rho around the parameters, with the function at rho - tau."""
        params = self.params

        def place(z: Array) -> tuple[Array, Array]:
            outer, tau = jnp.split(z, 2)
            if self.local:
                rho = params.theta + params.sigma * outer
            else:
                rho = _within(params, jax.scipy.special.ndtr(outer))
            return rho, rho - self.inner * tau

        batch = self._evaluated(fun, lambda z: place(z)[1], 2 * params.theta.size)
        return batch.draws.map(lambda z, _: jax.vmap(lambda z: place(z)[0])(z)), batch

    def log_density(self, rho: Float[Array, " n"]) -> Float[Array, ""]:
        """That of a point around the parameters, but for a number that is the same for all."""
        width = self.params.sigma
        if not self.local:
            return jnp.zeros((), rho.dtype)
        away = (rho - self.params.theta) / width
        return -jnp.sum(away**2) / 2 - jnp.sum(jnp.log(width))

    def smoothed(self, fun: Callable[[PyTree], Any]) -> Batch:
        """The function around the parameters themselves, smoothed by the inner kernel alone."""
        theta = self.params.theta
        return self._evaluated(fun, lambda z: theta - self.inner * z, theta.size)

    def mean(self, batch: Batch) -> tuple[Array, Array]:
        """The mean of a batch and its standard error, which one pair alone does not have."""
        value = combine(batch, jnp.zeros(batch.draws.n, batch.draws.dtype))
        if batch.draws.num > self.sampler.group(batch.draws.num, batch.draws.n):
            return value, value_stderr(batch, value)
        return value, jnp.full_like(value, jnp.nan)

    def _evaluated(self, fun: Callable, place: Callable[[Array], Array], size: int) -> Batch:
        """One batch of the function at `place(z)`, of normal z of this size."""
        params = self.params
        batch = evaluate(
            lambda z, _: fun(params.layout.tree(params.clip(place(z)))),
            take_apart(jnp.zeros(size, params.theta.dtype), 1.0, None),
            self.key,
            num_samples=self.num_samples,
            sampler=self.sampler,
            baseline=as_baseline("none"),
            batch_size=None,
            nonfinite=self.nonfinite,
        )
        if batch.log_ratio is not None:
            raise ValueError(f"{self.sampler} has weights: ZeroGrads needs points that are normal")
        return batch


def inner_width(params: Params, y: PyTree, width: PyTree) -> Float[Array, " n"]:
    """The width of the smoothing kernel; zero is allowed, unlike for the locality."""
    if width is None:
        return _INNER * params.sigma
    try:
        widths = jax.tree.leaves(jax.tree.broadcast(width, y))
    except ValueError as error:
        raise ValueError(
            "inner_sigma must be a number or a pytree with the structure of the parameters, "
            f"{jax.tree.structure(y)}, not {jax.tree.structure(width)}"
        ) from error
    for w in filter(is_concrete, widths):
        if not np.all((np.asarray(w) >= 0) & np.isfinite(w)):
            raise ValueError(f"inner_sigma = {w} must be finite, and positive or zero")
    return params.layout.vector(widths)


def share(batch: Batch) -> Float[Array, " N"]:
    """The weight of each sample in a mean over those that count."""
    valid = 1 if batch.valid is None else batch.valid.astype(batch.scale.dtype)
    return jnp.full(batch.draws.num, batch.scale) * valid


def log(values: Float[Array, " N"]) -> Float[Array, " N"]:
    """The logarithm, finite at zero; NaN below."""
    floor = jnp.finfo(values.dtype).tiny
    return jnp.where(values < 0, jnp.nan, jnp.log(jnp.maximum(values, floor)))


def check_box(params: Params) -> None:
    """Raises ValueError unless there are bounds, and finite ones as far as can be told now."""
    if params.bounds is None:
        raise ValueError("local=False samples all that is within the bounds: give bounds")
    low, high = params.bounds
    if is_concrete(span := high - low) and not np.all(np.isfinite(span)):
        raise ValueError("local=False samples all that is within the bounds: give finite bounds")


def _within(params: Params, share_of: Array) -> Array:
    """The point at these shares of the way from the lower to the upper bounds."""
    assert params.bounds is not None
    low, high = params.bounds
    return low + (high - low) * share_of
