"""The functions whose derivatives are estimated, each with its smoothed value in closed form.

So the truth is exact: AD of a closed form in float64, not the average of many samples. `smoothed`
takes a width for each parameter, so that it also serves methods that blur one parameter alone.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.special import ndtr
from jaxtyping import Array, Float

import smoothdiff as sd
from benchmarks.scenes import blurred_texture as texture
from benchmarks.tasks import boxes

PIXELS = 32


class Problem(NamedTuple):
    """A scalar function, its width of smoothing, and where its derivatives are asked for.

    `smoothed(y, sigma)` is E[fun(y + sigma z)]. `terms` gives the terms that add up to `fun`, each
    of which depends on few parameters, as `support` says.
    """

    name: str
    title: str
    n: int
    sigma: float
    fun: Callable[[Array], Array]
    smoothed: Callable[[Array, Array], Array]
    position: Callable[[Array], Array]
    quantities: tuple[str, ...] = ("gradient", "hessian", "hvp")
    terms: Callable[[Array], Array] | None = None
    support: Any = None


def squares(name: str, sigma: float, reference: tuple[float, ...]) -> Problem:
    """Hard-edged squares that add up, against their picture at the reference."""
    n = len(reference)

    def target(dtype) -> Array:
        return boxes.draw(jnp.asarray(reference, dtype), PIXELS)

    def fun(y: Float[Array, "n"]) -> Float[Array, ""]:
        return jnp.mean((boxes.draw(y, PIXELS) - target(y.dtype)) ** 2)

    def smoothed(y: Float[Array, "n"], sigma: Float[Array, "n"]) -> Float[Array, ""]:
        # a square covers a pixel with probability p, each square for itself
        middles = (jnp.arange(PIXELS, dtype=y.dtype) + 0.5) / PIXELS
        away, half = middles[None, :] - y[:, None], boxes.SIDE / PIXELS / 2
        inside = ndtr((away + half) / sigma[:, None]) - ndtr((away - half) / sigma[:, None])
        p = jnp.einsum("kx,ky->kyx", inside[0::2], inside[1::2])
        colours = jnp.asarray(boxes.COLOURS[: n // 2], y.dtype)
        mean = jnp.einsum("kyx,kc->yxc", p, colours)
        variance = jnp.einsum("kyx,kc->yxc", p * (1 - p), colours**2)
        return jnp.mean(variance + (mean - target(y.dtype)) ** 2)

    return Problem(
        name=name,
        title=f"{name.capitalize()}: hard-edged squares in {n}-D",
        n=n,
        sigma=sigma,
        fun=fun,
        smoothed=smoothed,
        position=lambda key: jax.random.uniform(key, (n,), minval=0.2, maxval=0.8),
    )


def texels() -> Problem:
    """The texture of `scenes/blurred_texture.py`, half-way between noise and the reference."""
    n = texture.PIXELS**2
    grid = lambda y: y.reshape(texture.PIXELS, texture.PIXELS)
    local = sd.local_support(texture.RADIUS)

    def smoothed(y: Float[Array, "1024"], sigma: Float[Array, "1024"]) -> Float[Array, ""]:
        # a blurred pixel is a normal variable, and each level has a share of it
        squares = jnp.asarray(texture.BLUR**2, y.dtype)
        mean, width = texture.blurred(grid(y)), jnp.sqrt(squares @ grid(sigma) ** 2 @ squares.T)
        values = jnp.arange(texture.LEVELS, dtype=y.dtype) / (texture.LEVELS - 1)
        edges = (values[:-1] + values[1:]) / 2
        below = ndtr((edges[:, None, None] - mean[None]) / width[None])
        share = jnp.diff(jnp.pad(below, ((1, 1), (0, 0), (0, 0)), constant_values=(0, 1)), axis=0)
        target = texture.draw(jnp.asarray(texture.REFERENCE, y.dtype))
        return jnp.sum(share * (values[:, None, None] - target[None]) ** 2)

    def position(key: Array) -> Array:
        noise = jax.random.uniform(key, (n,))
        return (jnp.asarray(texture.REFERENCE, noise.dtype).reshape(-1) + noise) / 2

    return Problem(
        name="texture",
        title="Texture: 1,024 texels, blurred and quantised",
        n=n,
        sigma=0.1,
        fun=lambda y: jnp.sum(texture.terms(grid(y))),
        smoothed=smoothed,
        position=position,
        quantities=("gradient",),
        terms=lambda y: texture.terms(grid(y)),
        support=lambda y: local(grid(y)),
    )


PROBLEMS: dict[str, Callable[[], Problem]] = {
    "box2": partial(squares, "box2", 0.15, (0.5, 0.5)),
    "box10": partial(squares, "box10", 0.1, boxes.BOX10_REFERENCE),
    "texture": texels,
}
