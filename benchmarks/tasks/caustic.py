"""Caustic: the shape of a slab of glass that bends parallel light into a picture.

After the Caustic task of ZeroGrads (supplement 2.2) and appendix K of higher-order differentiable
rendering. The lower side of the slab is a height field, a cubic B-spline with 32 x 32 coefficients.
Light comes straight down from afar, is refracted there, and falls on a receiver. A pixel of the
picture counts the rays that meet it, so the picture is piecewise constant. A coefficient moves the
light of its surroundings, and to wherever it is sent. Where that is follows from the slab by
Snell's law, so there is a support that moves with the light.

What is sought is a known slab that draws a face; the paper's is any slab that draws a picture.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import interpolate

import smoothdiff as sd
from benchmarks._task import Effort, Problem, Score, Task, entry

SIDE = 32  # coefficients
MIDDLES = (np.arange(SIDE) - 1) / (SIDE - 3)  # of the splines; those at the edge are outside
INDEX = 1.33  # of refraction
DISTANCE = 1.0  # of the receiver, in widths of the slab
HEIGHT = 0.01  # of a coefficient of 1, likewise
SIGMA, BOUND = 0.05, 2.0
REACH = 2.0  # tiles around where the light of a coefficient's place falls
WIDTH = 0.045  # of the ridges of what is sought, which bring parallel light to a line


def build(full: bool, **named: Any) -> Task:
    """Starts are almost flat. Quick: 128² rays, 32² pixels; full: 256² and 64²."""
    rays, pixels = (256, 64) if full else (128, 32)
    much = Effort(100_000, 600, seeds=10) if full else Effort(20_000, 120, seeds=2)
    reference = jnp.asarray(face(), jnp.float32)
    target = jax.jit(lambda y: draw(y, rays, pixels))(reference)

    def residuals(y: Float[Array, "32 32"]) -> Float[Array, "32 32 rest"]:
        """As many tiles as there are coefficients, each with its pixels."""
        side = pixels // SIDE
        tiles = (draw(y, rays, pixels) - target).reshape(SIDE, side, SIDE, side)
        return jnp.swapaxes(tiles, 1, 2).reshape(SIDE, SIDE, -1)

    def image(y: Float[Array, "32 32"]) -> Float[Array, "height width 3"]:
        return jnp.repeat(draw(y, rays, pixels)[..., None] / 4, 3, axis=-1)

    return Task(
        problem=Problem(
            bounds=(jnp.full_like(reference, -BOUND), jnp.full_like(reference, BOUND)),
            sigma=SIGMA,
            budget=much.budget,
            residuals=residuals,
            support=sd.moving_support(around),
        ),
        score=Score(reference, image=image),
        start=lambda seed: 0.05 * jax.random.normal(jax.random.key(seed), (SIDE, SIDE)),
        seeds=much.seeds,
        notes=f"{rays} x {rays} rays, {pixels} x {pixels} pixels. A wave that is even over the "
        "slab does not move light: the parameter error says little.",
        **named,
    )


def around(y: Float[Array, "32 32"]) -> Callable[[Float[Array, "32 32"]], Array]:
    """The tiles, one for each coefficient, near to where the light of its place falls."""
    falls = SIDE * land(y, np.clip(MIDDLES, 0, 1)).reshape(2, 1, -1)
    tiles = jnp.arange(SIDE, dtype=y.dtype)[None, :, None] + 0.5
    column, row = (jnp.abs(falls - tiles) < REACH).astype(y.dtype)
    near = row[:, None] * column[None]
    return lambda params: near @ params.ravel()


def draw(y: Float[Array, "32 32"], rays: int, pixels: int) -> Float[Array, "pixels pixels"]:
    """The light on the receiver: 1 in each pixel if nothing is bent."""

    @jax.custom_batching.sequential_vmap  # pictures at once take eight times as long
    def one(y: Float[Array, "32 32"]) -> Float[Array, "pixels pixels"]:
        middles = (np.arange(rays) + 0.5) / rays
        column: Array
        row: Array
        column, row = jnp.floor(land(y, middles) * pixels).astype(jnp.int32)
        inside = (column >= 0) & (column < pixels) & (row >= 0) & (row < pixels)
        pixel = jnp.where(inside, row * pixels + column, pixels**2)
        count = jnp.zeros(pixels**2, y.dtype).at[pixel.ravel()].add(1, mode="drop")
        return count.reshape(pixels, pixels) * (pixels / rays) ** 2

    return one(y)


def land(
    y: Float[Array, "32 32"], places: Float[np.ndarray, " rays"]
) -> Float[Array, "2 rays rays"]:
    """Where rays from a grid of places on the slab meet the receiver, in widths of the slab.

    To the right and downwards.
    """
    value, slope = (jnp.asarray(basis, y.dtype) for basis in _basis(places))
    height = HEIGHT * value @ y @ value.T
    steep = HEIGHT * jnp.stack([value @ y @ slope.T, slope @ y @ value.T])
    # Snell's law for light along (0, 0, 1), from glass into air, and a normal (-slope, 1)
    cosine = jax.lax.rsqrt(1 + jnp.sum(steep**2, axis=0))
    bent = jnp.sqrt(1 - INDEX**2 * (1 - cosine**2)) - INDEX * cosine
    aside = -(bent * cosine)[None] * steep
    down = INDEX + bent * cosine
    along = jnp.asarray(places, y.dtype)
    origin = jnp.stack(jnp.meshgrid(along, along))
    return origin + aside * ((DISTANCE - height) / down)[None]


def face() -> Float[np.ndarray, "32 32"]:
    """Coefficients of a round face: ridges as high as brings light to lines on the receiver."""
    x, y = np.meshgrid(MIDDLES - 0.5, MIDDLES - 0.5)
    radius = np.hypot(x, y)
    lines = [
        radius - 0.36,
        np.hypot(x - 0.13, y + 0.1),
        np.hypot(x + 0.13, y + 0.1),
        np.where(y > 0.08, radius - 0.2, np.inf),
    ]
    focus = WIDTH**2 / ((INDEX - 1) * DISTANCE)
    return focus / HEIGHT * np.exp(-0.5 * (np.min(np.abs(lines), axis=0) / WIDTH) ** 2)


def _basis(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(rays, 32): the splines, and their slopes, at these places."""
    step = 1 / (SIDE - 3)
    knots = step * (np.arange(SIDE + 4) - 3)
    spline = interpolate.BSpline(knots, np.eye(SIDE), 3)
    return spline(places), spline.derivative()(places)


TASKS = entry(
    "large",
    build,
    "caustic",
    "Caustic: 1,024 coefficients of a refracting height field",
    parameters=1_024,
    plateaus=False,
)
