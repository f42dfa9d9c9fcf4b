"""A metal plate under a window in the ceiling, its roughness a texture, rendered by Monte Carlo.

A pixel sees one texel. The light of a distant room is reflected by GGX microfacets (Walter et al.
2007) with Smith's height-correlated masking and Schlick's Fresnel term, and directions are drawn
from the visible normals (Heitz 2018). The picture is smooth in the roughness, but one sample says
little about it. Where the plate mirrors the middle of a pane it says least: roughness hardly shows.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.scenes import _monte_carlo
from benchmarks.scenes._monte_carlo import mean_of

REFLECTANCE: Any = np.array([[[0.95, 0.79, 0.55]]])  # of the metal at normal incidence, linear RGB
LOW, HIGH = 0.05, 1.0  # of the roughness; GGX's alpha is its square
CAMERA = np.array([[[0.0, -1.6, 2.2]]])  # the plate is [-1, 1]² in the plane z = 0
COLUMNS, LINES = (-0.4, 0.0, 0.4), (0.26, 0.72, 1.18)  # of a window of panes in the ceiling
HALF = (0.18, 0.21)  # of a pane's size; the ceiling is at height 1
COLOURS = (  # linear RGB radiance of the panes, a row for each of COLUMNS
    ((1.1, 1.0, 0.75), (1.0, 1.0, 0.95), (0.8, 1.0, 1.15)),
    ((1.15, 0.85, 0.6), (1.3, 1.2, 1.0), (0.7, 0.95, 1.2)),
    ((0.95, 0.7, 0.5), (1.0, 0.85, 0.75), (0.6, 0.75, 1.0)),
)
Image = Float[Array, "h w 3"]
Texture = Float[Array, "h w"]


def radiance(direction: Float[Array, "h w 3"]) -> Image:
    """What comes from a direction of the upper hemisphere: bright panes, and dim walls around."""
    up = direction[..., 2:]
    place = direction[..., :2] / jnp.maximum(up, 1e-4)  # at height 1
    seen = (0.03 + 0.03 * direction[..., 1:2]) * jnp.array([[[0.7, 0.85, 1.0]]])
    for x, colours in zip(COLUMNS, COLOURS, strict=True):
        for y, colour in zip(LINES, colours, strict=True):
            offset = jnp.abs(place - jnp.array([[[x, y]]]))
            inside = jnp.all(offset < jnp.array([[HALF]]), -1, keepdims=True)
            seen = jnp.where(inside, jnp.array([[colour]]), seen)
    return jnp.where(up > 0, seen, 0.0)


def shade(roughness: Texture, jitter: Float[Array, "h w 2"], point: Float[Array, "h w 2"]) -> Image:
    """One sample of each pixel: `jitter` places it on the texel, `point` chooses the direction.

    The direction is drawn for the roughness as it is and detached from it, so the derivative is
    that of the reflectance alone.
    """
    view = _view(jitter)
    alpha = roughness**2
    sampled = jax.lax.stop_gradient(alpha)
    half = _visible_normal(view, sampled, point)
    light = 2 * jnp.sum(view * half, -1, keepdims=True) * half - view
    cosine = jnp.maximum(jnp.sum(view * half, -1, keepdims=True), 0.0)
    fresnel = REFLECTANCE + (1 - REFLECTANCE) * (1 - cosine) ** 5
    reflected = _distribution(half, alpha) * _masking(view, light, alpha)
    drawn = _distribution(half, sampled) * _masking(view, None, sampled)
    ratio = jnp.where(light[..., 2] > 0, reflected / drawn, 0.0)
    return fresnel * radiance(light) * ratio[..., None]


def render(roughness: Texture, key: Array, samples: int) -> Image:
    """The mean of so many samples a pixel."""
    numbers = lambda key: jax.random.uniform(key, (2, *roughness.shape, 2), roughness.dtype)
    sample = lambda key: shade(roughness, *numbers(key))
    return mean_of(sample, jax.random.split(key, samples))


def gradient(
    roughness: Texture, key: Array, reference: Image, *, primal: int, samples: int
) -> Texture:
    """The gradient of the loss, unbiased: picture and derivative have samples of their own."""
    key_primal, key_derivative = jax.random.split(key)
    seen = render(roughness, key_primal, primal)
    sample = lambda y: render(y, key_derivative, samples)
    return _monte_carlo.gradient(sample, roughness, seen, reference)


@partial(jax.jit, static_argnames="samples")
def exact(roughness: Texture, samples: int) -> Image:
    """The picture by the same well-spread samples at every call, another shift for each pixel."""
    shape = (*roughness.shape, 2)
    shift = jax.random.uniform(jax.random.key(0), shape, roughness.dtype)
    middle = jnp.full(shape, 0.5, roughness.dtype)
    sequence = np.outer(np.arange(samples), [0.7548776662, 0.5698402910]) % 1  # Roberts' R2
    sample = lambda point: shade(roughness, middle, (shift + point[None, None]) % 1)
    return mean_of(sample, jnp.asarray(sequence, roughness.dtype))


def texture(size: int) -> np.ndarray:
    """The roughness that is sought: smooth fields, tiles, a disc, a ring, scratches."""
    y, x = (np.mgrid[:size, :size] + 0.5) / size
    found = 0.32 + 0.10 * np.sin(2.2 * x + 1.0) * np.cos(2.5 * y)
    tiles = ((np.floor(6 * x) + np.floor(6 * y)) % 2 == 0) & (x < 0.5) & (y > 0.5)
    found = np.where(tiles, 0.55 + 0.1 * x, found)
    found = np.where((x - 0.72) ** 2 + (y - 0.27) ** 2 < 0.18**2, 0.22 + 0.25 * y, found)
    ring = np.abs(np.hypot(x - 0.72, y - 0.27) - 0.2) < 0.02
    found = np.where(ring, 0.65, found)
    found = np.where((np.abs(x - 0.28) < 0.16) & (np.abs(y - 0.25) < 0.16), 0.5 - 0.4 * x, found)
    for offset, slope in ((0.05, 0.25), (0.32, -0.2), (0.13, 0.6)):  # scratches
        scratch = (np.abs(y - 0.62 - offset - slope * (x - 0.75)) < 0.006) & (x > 0.53)
        found = np.where(scratch, 0.16, found)
    return found.astype(np.float32)


def _view(jitter: Float[Array, "h w 2"]) -> Float[Array, "h w 3"]:
    """From where a sample lies on the plate to the camera; the first line is the far edge."""
    h, w, _ = jitter.shape
    row, column = jnp.asarray(np.mgrid[:h, :w], jitter.dtype)
    x = 2 * (column + jitter[..., 0]) / w - 1
    y = 1 - 2 * (row + jitter[..., 1]) / h
    view = jnp.asarray(CAMERA, jitter.dtype) - jnp.stack([x, y, jnp.zeros_like(x)], -1)
    return view / jnp.linalg.norm(view, axis=-1, keepdims=True)


def _visible_normal(
    view: Float[Array, "h w 3"], alpha: Texture, point: Float[Array, "h w 2"]
) -> Float[Array, "h w 3"]:
    """A microfacet's normal, as often as it is seen from `view` (Heitz 2018, listing 1)."""
    stretch = jnp.stack([alpha, alpha, jnp.ones_like(alpha)], -1)
    v = _unit(stretch * view)
    zero = jnp.zeros_like(alpha)
    along = _unit(jnp.stack([-v[..., 1], v[..., 0], zero], -1))  # the view is never quite vertical
    across = jnp.cross(v, along)
    radius, angle = jnp.sqrt(point[..., 0]), 2 * jnp.pi * point[..., 1]
    p, q = radius * jnp.cos(angle), radius * jnp.sin(angle)
    share = 0.5 * (1 + v[..., 2])
    q = (1 - share) * jnp.sqrt(jnp.maximum(1 - p**2, 0)) + share * q
    r = jnp.sqrt(jnp.maximum(1 - p**2 - q**2, 0))
    normal = p[..., None] * along + q[..., None] * across + r[..., None] * v
    height = jnp.maximum(normal[..., 2], 1e-6)
    return _unit(stretch * jnp.stack([normal[..., 0], normal[..., 1], height], -1))


def _unit(v: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
    return v / jnp.maximum(jnp.linalg.norm(v, axis=-1, keepdims=True), 1e-12)


def _distribution(half: Float[Array, "h w 3"], alpha: Texture) -> Texture:
    """GGX's density of normals."""
    return alpha**2 / (jnp.pi * (half[..., 2] ** 2 * (alpha**2 - 1) + 1) ** 2)


def _masking(view: Float[Array, "h w 3"], light: Array | None, alpha: Texture) -> Texture:
    """Smith's share of microfacets that are seen, and lit too where there is a `light`."""
    shadow = 1 + _lambda(view, alpha)
    return 1 / (shadow if light is None else shadow + _lambda(light, alpha))


def _lambda(direction: Float[Array, "h w 3"], alpha: Texture) -> Texture:
    cosine2 = jnp.maximum(direction[..., 2] ** 2, 1e-8)
    return (jnp.sqrt(1 + alpha**2 * (1 - cosine2) / cosine2) - 1) / 2
