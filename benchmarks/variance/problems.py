"""The functions whose derivatives are estimated, each with its smoothed value in closed form.

So the truth is exact: AD of a closed form in float64, not the average of many samples. `smoothed`
takes a width for each parameter, so that it also serves methods that blur one parameter alone.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
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


def quad() -> Problem:
    """The papers' quadratic bowl."""

    def fun(y: Float[Array, "2"]) -> Float[Array, ""]:
        return 5 * y[0] ** 2 + 5 * y[1] ** 2 + 7.5 * y[0] * y[1]

    return Problem(
        name="quad",
        title="Quad: a quadratic in 2-D",
        n=2,
        sigma=1.0,
        fun=fun,
        smoothed=lambda y, sigma: fun(y) + 5 * jnp.sum(sigma**2),
        position=lambda key: jax.random.uniform(key, (2,), minval=-2, maxval=2),
    )


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


def sphere() -> Problem:
    """A shaded sphere of which everything is smooth: light (2), colour (3), strength and gloss."""
    grid = (np.arange(12) + 0.5) / 6 - 1
    x, y = np.meshgrid(grid, grid)
    inside = x**2 + y**2 < 0.9
    normals = np.stack([x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))], -1)[inside]
    reference = (0.3, -0.2, 0.7, 0.5, 0.3, 0.4, 0.0)
    z = _normal_points(7)

    def shade(y: Float[Array, "7"]) -> Float[Array, "pixels 3"]:
        light = jnp.stack([y[0], y[1], jnp.ones((), y.dtype)])
        light = light / jnp.sqrt(jnp.sum(light**2))
        normal = jnp.asarray(normals, y.dtype)
        facing = normal @ light
        # Phong's mirrored direction towards the eye, in a lobe that is smooth all around
        mirrored = 2 * facing * normal[:, 2] - light[2]
        highlight = y[5] * jnp.exp(jnp.exp(2 + y[6]) * (mirrored - 1))
        return ((1 + facing) / 2)[:, None] * y[None, 2:5] + highlight[:, None]

    def fun(y: Float[Array, "7"]) -> Float[Array, ""]:
        return jnp.mean((shade(y) - shade(jnp.asarray(reference, y.dtype))) ** 2)

    def smoothed(y: Float[Array, "7"], sigma: Float[Array, "7"]) -> Float[Array, ""]:
        # AD of a smooth function at many even points has hardly any noise
        at = jax.checkpoint(lambda z: fun(y + sigma * z))
        return jnp.mean(jax.lax.map(at, jnp.asarray(z, y.dtype), batch_size=1024))

    def position(key: Array) -> Array:
        return jnp.asarray(reference) + jax.random.uniform(key, (7,), minval=-0.4, maxval=0.4)

    return Problem("sphere", "Sphere: smooth shading in 7-D", 7, 0.2, fun, smoothed, position)


def _normal_points(n: int) -> Float[np.ndarray, "16384 n"]:
    draw, num = sd.Sobol().draw, 2**14
    return np.asarray(draw(jax.random.key(1), 0, num, num, n, jnp.float32)[0])


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
    "quad": quad,
    "box2": partial(squares, "box2", 0.15, (0.5, 0.5)),
    "box10": partial(squares, "box10", 0.1, boxes.BOX10_REFERENCE),
    "sphere": sphere,
    "texture": texels,
}
