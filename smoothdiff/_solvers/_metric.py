"""The shape of the Gaussian that a solver samples with: widths, and directions where there are few.

Newton steps are right in any coordinates, but samples are not: where one direction is a thousand
times steeper than another, a round Gaussian sees nothing of the other. Sampling in the metric of
the Hessian makes all directions count alike.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from smoothdiff._products import dot

# most parameters for which directions are adapted with the widths; beyond, widths only, O(n)
MOST_DIRECTIONS = 64
# the most that a width changes in a step, relative to the others
_GAIN = 1.3
# so much farther from the center may clamping bring a point
_NEAR = 1.1
# an eigenvalue this small against the mean is as good as zero
_FLAT = 0.3


class Metric(eqx.Module):
    """x = M u: a matrix, or in many dimensions its diagonal alone."""

    matrix: Float[Array, "n n"] | Float[Array, " n"]
    inverse: Float[Array, "n n"] | Float[Array, " n"]

    @staticmethod
    def of(sigma: Float[Array, " n"], adapted: bool) -> "Metric":
        """The widths of the parameters, none of them correlated."""
        full = adapted and sigma.size <= MOST_DIRECTIONS
        return Metric(jnp.diag(sigma), jnp.diag(1 / sigma)) if full else Metric(sigma, 1 / sigma)

    def out(self, u: Float[Array, "*m n"]) -> Float[Array, "*m n"]:
        """Parameters from units of the width."""
        return _apply(self.matrix, u)

    def into(self, x: Float[Array, "*m n"]) -> Float[Array, "*m n"]:
        """Units of the width from parameters."""
        return _apply(self.inverse, x)

    def unit(self) -> "Metric":
        """No change."""
        one = jnp.ones_like(self.matrix[0] if self.matrix.ndim == 2 else self.matrix)
        return Metric(one, one)

    def widest(self) -> Float[Array, ""]:
        """The largest standard deviation of a parameter."""
        if self.matrix.ndim == 2:
            return jnp.max(jnp.linalg.norm(self.matrix, axis=1))
        return jnp.max(self.matrix)

    def bounded(
        self,
        center: Float[Array, " n"],
        u: Float[Array, " n"],
        low: Float[Array, " n"],
        high: Float[Array, " n"],
        mirror: bool,
    ) -> Float[Array, " n"]:
        """The point `center` + M u, or what the bounds leave of it.

        Clamped entry by entry if that brings it no farther from the center. In a narrow valley it
        does, by far: there the point is pulled back along its ray. A sample, not a step, may take
        the opposite ray instead (`mirror`) where that has more room.
        """
        move = self.out(u)
        clamped = jnp.clip(center + move, low, high)
        near = jnp.linalg.norm(self.into(clamped - center)) <= _NEAR * jnp.linalg.norm(u)

        def share(move: Array) -> Array:
            room = jnp.where(move > 0, high - center, low - center)
            return jnp.min(jnp.where(move != 0, room / jnp.where(move != 0, move, 1), jnp.inf))

        forth = share(move)
        if mirror:
            back = share(-move)
            move = jnp.where(back > forth, -move, move)
            forth = jnp.maximum(forth, back)
        return jnp.where(near, clamped, jnp.clip(center + jnp.minimum(forth, 1) * move, low, high))

    def slope(self, grad: Float[Array, " n"]) -> Float[Array, " n"]:
        """The gradient in the parameters from that in units of the width."""
        return _apply(self.inverse.T, grad)

    def holding(self, active: Bool[Array, " n"]) -> Callable[[Array], Array]:
        """Takes from a step, in units of the width, what would move parameters that are active."""
        if self.matrix.ndim == 1:
            return lambda u: jnp.where(active, 0, u)
        rows = jnp.where(active[:, None], self.matrix, 0)
        inverse = jnp.linalg.pinv(rows)

        def hold(u: Array) -> Array:
            return u - _apply(inverse, _apply(rows, u))

        return hold

    def adapted(
        self,
        curvature: Callable[[Array], Array],
        diagonal: Float[Array, " n"],
        noise: Float[Array, ""],
    ) -> tuple["Metric", "Metric"]:
        """The next metric M T and T, which has widths of the curvature's -1/2, as far as known.

        `curvature` and `diagonal` are the Hessian's in units of the width, `noise` what its
        eigenvalues may owe to chance. The volume stays as it is.
        """
        vectors = None
        if self.matrix.ndim == 2:
            hessian = jax.vmap(curvature)(jnp.eye(diagonal.size, dtype=diagonal.dtype))
            diagonal, vectors = jnp.linalg.eigh((hessian + hessian.T) / 2)
        sizes = jnp.abs(diagonal)
        mean = jnp.mean(sizes)
        floor = _FLAT * mean + noise
        widths = jnp.sqrt((mean + floor) / (sizes + floor))
        widths = jnp.where(mean > 0, jnp.clip(widths, 1 / _GAIN, _GAIN), 1)
        widths /= jnp.exp(jnp.mean(jnp.log(widths)))
        if vectors is None:
            return Metric(self.matrix * widths, self.inverse / widths), Metric(widths, 1 / widths)
        turn, back = (dot(vectors * size[None], vectors.T) for size in (widths, 1 / widths))
        matrix = dot(self.matrix, turn)
        return Metric(matrix, jnp.linalg.inv(matrix)), Metric(turn, back)


def _apply(factor: Array, rows: Array) -> Array:
    if factor.ndim == 2:
        return dot(rows, factor.T)
    return rows * (factor if rows.ndim == 1 else factor[None])
