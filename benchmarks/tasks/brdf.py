"""BRDF: the seven parameters of Phong's model, from one picture of a lit sphere.

Appendix G of the paper on higher-order rendering. Everything is smooth in the parameters, so that
there is a Hessian to compare with.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks._task import Effort, Task, entry
from benchmarks.tasks._drawn import drawn, uniform

LIGHT = np.array([1.5, 1.5, 3.0])  # of a sphere of radius 1 at the origin; the eye is far along z
# diffuse and specular colour, and gloss: 0 to 1 for exponents 1 to 256
REFERENCE = (0.7, 0.3, 0.2, 0.4, 0.5, 0.6, 0.6)
SPARED = 0.05  # of the range, by the starts, on either side


def shade(y: Float[Array, "7"], pixels: int) -> Float[Array, "pixels pixels 3"]:
    """The picture, pixels x pixels, linear RGB."""
    diffuse, specular, exponent = y[0:3], y[3:6], jnp.exp2(8 * y[6])
    facing, mirrored, lit = (jnp.asarray(part, y.dtype) for part in _geometry(pixels))
    highlight = jnp.exp(exponent * jnp.log(mirrored))
    shaded = facing[..., None] * diffuse[None, None]
    return lit[..., None] * (shaded + highlight[..., None] * specular[None, None])


def _geometry(pixels: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cosines of light with normal and of mirrored light with the eye, and where light falls."""
    line = (np.arange(pixels) + 0.5) / pixels * 2.2 - 1.1
    x, y = np.meshgrid(line, -line)
    z = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    normal = np.stack([x, y, z], -1)
    light = LIGHT - normal
    light /= np.linalg.norm(light, axis=-1, keepdims=True)
    facing = np.sum(normal * light, -1)
    mirrored = 2 * facing * z - light[..., 2]
    lit = (x**2 + y**2 < 1) & (facing > 0)
    # a power of zero has no derivative in the exponent
    return np.maximum(facing, 0), np.maximum(mirrored, 1e-6), lit


def build(full: bool, **named: Any) -> Task:
    """Quick: 32 x 32 pixels; full: 64 x 64. Parameters are between 0 and 1."""
    pixels = 64 if full else 32
    draw = lambda y: shade(y, pixels)
    return drawn(
        full,
        draw=draw,
        reference=REFERENCE,
        sigma=0.15,
        effort=(Effort(2000, 15, seeds=3), Effort(5000, 60, seeds=20)),
        start=uniform(7, SPARED, 1 - SPARED),
        image=draw,
        notes=f"{pixels} x {pixels} pixels",
        **named,
    )


TASKS = entry(
    "scene",
    build,
    "brdf",
    "BRDF: Phong's model of a sphere under a point light",
    parameters=7,
    plateaus=False,
)
