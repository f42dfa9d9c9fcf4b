"""Evaluations that run at once: steps at several radii, and points beside the model's step."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

# at most so many radii; more tell less than points beside the step
_RADII = 3
# a step that differs from another by less than this share of its length is the same
_SAME = 1e-3
# how far points are beside a step, in lengths of it: not so far as its start or its double
_AWAY = 0.8


def radii(radius: Float[Array, ""], count: int) -> Float[Array, " M"]:
    """The radii of steps where so many evaluations run at once: the radius, twice, half of it.

    For every second evaluation one.
    """
    factors = [2.0 ** -((k + 1) // 2 * (-1) ** k) for k in range(min((count + 1) // 2, _RADII))]
    return radius * jnp.asarray(factors, radius.dtype)


def least_length(place: Float[Array, " n"]) -> Float[Array, ""]:
    """How far from there a function can be told apart: the root of the rounding."""
    return jnp.sqrt(jnp.finfo(place.dtype).eps) * jnp.max(jnp.abs(place))


def beside(
    steps: Float[Array, "M n"],
    step: Float[Array, " n"],
    radius: Float[Array, ""],
    least: Float[Array, ""],
    inside: Callable[[Float[Array, "K n"]], Float[Array, "K n"]],
    count: int,
    turn: Int[Array, ""],
) -> tuple[Float[Array, "K n"], Bool[Array, " K"]]:
    """So many points, and which of them are no steps.

    Those lie beside the end of the model's step, almost as far as that is long, along one axis
    after the other, to the side that the bounds leave longer. What is another step once more makes
    way for them, too: where the minimiser is within the region, it is that of all radii.

    Args:
        steps: steps, or a point that teaches the model in place of the first.
        step: that of the model.
        radius: of the region, for a step of no length.
        least: how far beside a step of little length.
        inside: takes points within the bounds.
        count: how many are evaluated at once.
        turn: how many were evaluated before, for the axes.
    """
    if count == 1:
        return steps, jnp.zeros(1, bool)
    n, size = len(step), jnp.linalg.norm(steps, axis=1)
    between = jnp.linalg.norm(steps[:, None] - steps[None], axis=2)
    again = jnp.any(jnp.tril(between <= _SAME * size[:, None], -1), axis=1)
    more = count - len(steps)
    others = jnp.concatenate([again, jnp.ones(more, bool)])
    steps = jnp.concatenate([steps, jnp.zeros((more, n), steps.dtype)])
    # one axis after the other, then back along each
    axis = turn // count * more + jnp.cumsum(others, dtype=turn.dtype)
    sign = jnp.where(axis // n % 2 == 0, 1, -1).astype(steps.dtype)
    away = sign[:, None] * jax.nn.one_hot(axis % n, n, dtype=steps.dtype)
    length = jnp.linalg.norm(step)
    length = jnp.maximum(jnp.where(length > 0, length, radius), least)
    forth, back = (inside(step[None] + s * _AWAY * length * away) for s in (1, -1))
    moved = [jnp.linalg.norm(end - step[None], axis=1) for end in (forth, back)]
    ends = jnp.where((2 * moved[0] < moved[1])[:, None], back, forth)
    return jnp.where(others[:, None], ends, steps), others
