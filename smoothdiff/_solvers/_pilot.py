"""The pilot of a search: pairs of points, wider and wider, until the function changes.

Around the start of a plateau no model says anything, and rounds of samples find its end late.
Directions are random, both ways along each, four times as far every time, from the width of the
first points on. Within a box there are more, anywhere in it: pairs would soon be in its corners.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from smoothdiff._params import Params
from smoothdiff._solvers._box import has_box, over_box

# how many pairs, each so many times as far as the one before
PAIRS, _WIDER = 5, 4.0
# points in a box for each parameter, and one: as many as end a run that finds nothing lower
_IN_BOX = 20


class Pilot(eqx.Module):
    """How many points were `tried`; where the function changed, in units of sigma, or zero.

    `follows` is the stage that comes next if it never does.
    """

    tried: Int[Array, ""]
    length: Float[Array, ""]
    follows: Int[Array, ""]

    @staticmethod
    def start(like: Float[Array, " n"]) -> "Pilot":
        """None was tried."""
        none = jnp.zeros((), jnp.int32)
        return Pilot(none, jnp.zeros((), like.dtype), none)

    @staticmethod
    def length_in_box(n: int) -> int:
        """How many points it takes in a box, of n parameters."""
        return _IN_BOX * (n + 1)

    def left(self, params: Params) -> Bool[Array, ""]:
        """Whether there are more points to try."""
        most = self.length_in_box(params.theta.size)
        return self.tried < jnp.where(has_box(params), most, 2 * PAIRS)

    def points(
        self,
        params: Params,
        start: Float[Array, " n"],
        draw: Callable[[int], Float[Array, "k n"]],
        count: int,
    ) -> Float[Array, "K n"]:
        """The next points: anywhere in a box, else pairs around the start."""
        pairs = start[None] + params.sigma[None] * self.steps(draw(PAIRS), count)
        at = self.tried + jnp.arange(count, dtype=jnp.int32)
        return over_box(params, lambda: draw(self.length_in_box(len(start))), at, pairs)

    def steps(self, z: Float[Array, "k n"], count: int) -> Float[Array, "K n"]:
        """The next points, in units of sigma, along these directions."""
        at = jnp.minimum(self.tried + jnp.arange(count, dtype=jnp.int32), 2 * PAIRS - 1)
        along = z[at // 2]
        unit = along / jnp.linalg.norm(along, axis=1, keepdims=True)
        sign = (1 - 2 * (at % 2)).astype(z.dtype)
        return (sign * _WIDER ** (1 + at // 2).astype(z.dtype))[:, None] * unit

    def after(
        self,
        steps: Float[Array, "K n"],
        changed: Bool[Array, " K"],
        good: Bool[Array, " K"],
    ) -> "Pilot":
        """With points at these steps, of which some are `good`, and some of those have `changed`.

        Where the function is not finite it ends before that.
        """
        length: Array = jnp.linalg.norm(steps, axis=1)
        length = jnp.where(good, jnp.where(changed, length, jnp.inf), length / _WIDER)
        nearest = jnp.min(length)
        found = jnp.where(jnp.isfinite(nearest), nearest, 0)
        return Pilot(self.tried + len(steps), found, self.follows)
