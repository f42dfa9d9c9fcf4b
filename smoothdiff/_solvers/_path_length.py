"""Steps and sigma as long as the path of the last gradients says."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from smoothdiff._params import Params
from smoothdiff._spaces import SIGMA

# directions without a memory make a path of length one in each parameter, directions that are all
# the same one of two: in between steps are right
_RIGHT = 1.2
# the path is of the last n evaluations, and no shorter than what Adam remembers
_SHORTEST = 0.1
# the largest scale without bounds, the smallest, and the least sigma in spacings of its parameter
_MOST, _LEAST, _SPACINGS = 1e3, 1e-6, 8


class PathLength(eqx.Module):
    """What sigma and the steps are multiplied by, and the path that decides it."""

    scale: Float[Array, ""]
    path: Float[Array, " n"]

    @staticmethod
    def start(params: Params) -> "PathLength":
        """As given; the path has not begun."""
        theta = params.theta
        return PathLength(jnp.ones((), theta.dtype), jnp.zeros_like(theta))

    def within(self, params: Params) -> Float[Array, ""]:
        """The scale, so that samples around these parameters are other points, and few clamped."""
        layout = params.layout
        kept = zip(layout.dtypes, layout.smoothed, strict=True)
        spacing = max(float(jnp.finfo(dtype).eps) for dtype, smoothed in kept if smoothed)
        least = _SPACINGS * spacing * jnp.max(jnp.abs(params.theta) / params.sigma)
        least = jnp.maximum(least, _LEAST)
        most = jnp.asarray(_MOST, self.scale.dtype)
        if params.bounds is not None:
            # wider samples are clamped so often that their gradients agree on the bounds alone
            low, high = params.bounds
            span = high - low
            usual = jnp.min(jnp.where(span > 0, SIGMA * span / params.sigma, jnp.inf))
            most = jnp.clip(usual, 1, most)
        return jnp.clip(self.scale, jnp.minimum(least, most), most)

    def after(self, params: Params, grad: PyTree[Array], evaluations: int) -> "PathLength":
        """The next one, when so many evaluations gave this gradient at `params`."""
        n = params.theta.size
        rate = min(_SHORTEST, evaluations / n)
        slope = params.layout.vector(jax.tree.leaves(grad)) * params.sigma
        size = jnp.max(jnp.abs(slope))
        if params.bounds is not None:  # where the way is barred
            low, high = params.bounds
            at_low, at_high = params.theta <= low, params.theta >= high
            slope = jnp.where((at_low & (slope > 0)) | (at_high & (slope < 0)), 0, slope)
        free = slope / jnp.where(size > 0, size, 1)
        length = jnp.sqrt(jnp.sum(free**2))
        direction = free * math.sqrt(n) / jnp.where(length > 0, length, 1)
        next_path = (1 - rate) * self.path + math.sqrt(rate * (2 - rate)) * direction
        path = jnp.where(jnp.any(self.path != 0), next_path, direction)
        longer = jnp.clip(jnp.mean(path**2) - _RIGHT, -1, 1)
        # samples that are all the same say only that others are farther away
        longer, path = jnp.where(size > 0, longer, 1), jnp.where(size > 0, path, self.path)
        return PathLength(self.within(params) * jnp.exp(rate / 2 * longer), path)

    def failed(self) -> "PathLength":
        """The next one after a step whose samples were not finite: nearer ones may be."""
        return PathLength(self.scale / 2, self.path)


def steps_scaled(updates: PyTree[Array], params: Params, scale: Float[Array, ""]) -> PyTree[Array]:
    """Updates times the scale; those of leaves without a sigma stay as they are."""
    leaves, treedef = jax.tree.flatten(updates)
    return treedef.unflatten(
        [
            (u * scale.astype(u.dtype)) if smoothed else u
            for u, smoothed in zip(leaves, params.layout.smoothed, strict=True)
        ]
    )
