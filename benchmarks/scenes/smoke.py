"""A coloured volume of smoke, seen from around through a Monte Carlo renderer.

What a ray brings is emission and absorption, C = ∫ T σ ρ dt + T(end) background, where a voxel has
a density σ and an albedo ρ, and light comes evenly from everywhere. A jittered ray is marched
through the volume. A path tracer would take its colour from one place on it, drawn in proportion to
T σ and detached; so do the noisy gradients here, and they say little of all the other places.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.scenes import _monte_carlo
from benchmarks.scenes._monte_carlo import mean_of
from benchmarks.scenes.meshes import spiral

BACKGROUND = 1.0
DENSEST = 8.0  # absorption per unit of length of a density of 1; the volume is [-1, 1]³
REACH = 1.5  # a ray is marched from -REACH to REACH around the point nearest to the middle
FRAME = 1.2  # half the size of a picture
Image = Float[Array, "views pixels pixels 3"]


class Volume(NamedTuple):
    """The parameters."""

    density: Float[Array, "n n n 1"]
    albedo: Float[Array, "n n n 3"]


class Camera(NamedTuple):
    """Parallel rays from around: a direction for each view, and the axes of its picture."""

    forward: Float[Array, "views 3"]
    right: Float[Array, "views 3"]
    up: Float[Array, "views 3"]


def cameras(views: int) -> Camera:
    """From directions that are spread evenly over the sphere."""
    directions, angle = spiral(views)
    forward = -directions
    right = np.stack([-np.sin(angle), np.cos(angle), np.zeros(views)], -1)
    up = np.cross(right, forward)
    return Camera(*(jnp.asarray(each, jnp.float32) for each in (forward, right, up)))


@partial(jax.jit, static_argnames=("pixels", "steps", "samples"))
def render(
    volume: Volume, camera: Camera, key: Array, *, pixels: int, steps: int, samples: int
) -> Image:
    """The mean of so many rays a pixel, each with the colour of all that it passes."""
    sample = lambda key: _whole_colour(volume, _march(volume, camera, key, pixels, steps))
    return mean_of(sample, jax.random.split(key, samples))


def gradient(
    volume: Volume, camera: Camera, reference: Image, key: Array, *, steps: int, clean: bool
) -> Volume:
    """The gradient of the loss, unbiased: picture and derivative have rays of their own.

    If it is `clean` a ray is asked for the colour of all that it passes, not of one place drawn
    along it.
    """
    key_primal, key_ray, key_place = jax.random.split(key, 3)
    pixels = reference.shape[1]
    seen = render(volume, camera, key_primal, pixels=pixels, steps=steps, samples=1)

    def sample(volume: Volume) -> Image:
        ray = _march(volume, camera, key_ray, pixels, steps)
        return _whole_colour(volume, ray) if clean else _one_colour(volume, ray, key_place)

    return _monte_carlo.gradient(sample, volume, seen, reference)


class _Ray(NamedTuple):
    """What a ray meets: a voxel at each step, and the share of its light that each step sends."""

    voxels: Array
    shares: Float[Array, "views pixels pixels steps"]
    through: Float[Array, "views pixels pixels"]  # the share of the background


def _march(volume: Volume, camera: Camera, key: Array, pixels: int, steps: int) -> _Ray:
    """A ray through a random place of each pixel, with steps and voxels shifted at random."""
    views = camera.forward.shape[0]
    k_pixel, k_step, k_voxel = jax.random.split(key, 3)
    grid = jnp.asarray(np.mgrid[:pixels, :pixels], jnp.float32)[None]
    place = grid + jax.random.uniform(k_pixel, (views, 2, pixels, pixels))
    row, column = jnp.moveaxis(FRAME * (2 * place / pixels - 1), 1, 0)
    step = jax.random.uniform(k_step, (views, pixels, pixels, 1))
    step += jnp.arange(steps, dtype=jnp.float32).reshape(1, 1, 1, -1)
    width = 2 * REACH / steps
    forward, right, up = (axis[:, None, None, :] for axis in camera)
    origin = column[..., None] * right - row[..., None] * up
    points = origin[..., None, :] + (step * width - REACH)[..., None] * forward[..., None, :]
    shift = jax.random.uniform(k_voxel, (views, pixels, pixels, 1, 3)) - 0.5
    voxels, inside = _voxels(points, shift, volume.density.shape[0])
    depth = jnp.where(inside, volume.density.reshape(-1)[voxels], 0.0) * (DENSEST * width)
    before = jnp.cumsum(depth, -1) - depth
    return _Ray(voxels, jnp.exp(-before) * -jnp.expm1(-depth), jnp.exp(-jnp.sum(depth, -1)))


def _whole_colour(volume: Volume, ray: _Ray) -> Image:
    """The colour of all that each ray passes."""
    colours = volume.albedo.reshape(-1, 3)[ray.voxels]
    return jnp.einsum("vijs,vijsc->vijc", ray.shares, colours) + BACKGROUND * ray.through[..., None]


def _one_colour(volume: Volume, ray: _Ray, key: Array) -> Image:
    """The colour of one place on each ray, or of the background, drawn as often as its share."""
    *shape, steps = ray.shares.shape
    drawn = jax.lax.stop_gradient(jnp.cumsum(ray.shares, -1))
    chosen = jnp.sum(drawn < jax.random.uniform(key, (*shape, 1)), -1)
    at = jnp.minimum(chosen, steps - 1)[..., None]
    hit = (chosen < steps)[..., None]
    voxel = jnp.take_along_axis(ray.voxels, at, -1)[..., 0]
    share = jnp.where(hit, jnp.take_along_axis(ray.shares, at, -1), ray.through[..., None])
    colour = jnp.where(hit, volume.albedo.reshape(-1, 3)[voxel], BACKGROUND)
    return share / jax.lax.stop_gradient(jnp.maximum(share, 1e-12)) * colour


def _voxels(points: Array, shift: Array, n: int) -> tuple[Array, Array]:
    """One of the eight voxels around each point: shifts of up to half a voxel make it trilinear."""
    index = jnp.floor((points + 1) / 2 * n + shift).astype(jnp.int32)
    inside = jnp.all((index >= 0) & (index < n), -1)
    x, y, z = jnp.moveaxis(jnp.clip(index, 0, n - 1), -1, 0)
    return (x * n + y) * n + z, inside


def target(n: int) -> Volume:
    """The smoke that is sought: two plumes that wind around each other, with hard edges."""
    centre = (np.arange(n) + 0.5) / n * 2 - 1
    x, y, z = np.meshgrid(centre, centre, centre, indexing="ij")
    density = np.zeros((n, n, n))
    albedo = np.full((n, n, n, 3), 0.5)
    for phase, colour in ((0.0, (0.85, 0.35, 0.2)), (np.pi, (0.2, 0.45, 0.85))):
        reach = 0.25 + 0.12 * z
        around_x, around_y = 0.38 * np.cos(3 * z + phase), 0.38 * np.sin(3 * z + phase)
        distance = np.hypot(x - around_x, y - around_y)
        inside = (distance < reach) & (np.abs(z) < 0.85)
        density = np.where(inside, 0.5 - 0.25 * z, density)
        shade = 1 - 0.3 * (z[..., None] > 0.1)
        albedo = np.where(inside[..., None], shade * np.array(colour), albedo)
    core = np.sqrt(x**2 + y**2 + (z - 0.05) ** 2) < 0.16
    density = np.where(core, 1.0, density)
    albedo = np.where(core[..., None], np.array((0.9, 0.85, 0.25)), albedo)
    return Volume(jnp.asarray(density[..., None], jnp.float32), jnp.asarray(albedo, jnp.float32))
