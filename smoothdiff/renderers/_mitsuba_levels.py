"""`levels`: a Mitsuba scene beside a photograph, from few pixels and samples to all of them."""

import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from smoothdiff._levels import Level
from smoothdiff.renderers._mitsuba_renderer import renderer

# fewer samples of a picture than this cost what the call costs
_SAMPLES = 1024
# the fewest samples of a pixel: their noise must not hide what differs between two points
_FEW = 16


def levels(
    scene: Any,
    params: str | Sequence[str],
    photo: Float[np.ndarray | Array, "height width 3"],
    *,
    spp: int,
    inputs: Callable[[PyTree], Any] = lambda y: y,
    coarsest: int = 8,
    **options: Any,
) -> list[Level]:
    r"""A scene beside its photograph at several fidelities, for `smoothdiff.coarse_to_fine`.

    $$ r_k(y) = 2^k \, (\text{image}_k(y) - \text{photo}_k) $$

    The finest level has the pixels of the photograph, with `spp` samples each. Each coarser level
    has half as many pixels along a side, and a quarter of the samples of a pixel, but no fewer than
    16 for a pixel (or `spp`, if less) and 1,024 for the picture. Its photograph has the means of
    the pixels. The integrator stays the same, and the cost of a level is its number of samples. A
    coarse level that costs more than the finest is left out.

    Args:
        scene: as for `renderer`; the path of a file or a dict, as each level loads its own.
        params: as for `renderer`.
        photo: the photograph, linear RGB, of any size. Halves of it must be whole numbers of
            pixels, so a power of two allows most levels.
        spp: samples of a pixel at the finest level.
        inputs: a function from y to what `renderer` takes, by default y itself.
        coarsest: the least number of pixels along the shorter side.
        **options: as for `renderer`: `integrator`, `axis`, `sensor`, `variant`, `seed`, `noise`.

    Returns:
        The levels, the coarsest first. Their functions are those of y that `least_squares` wants,
        and take a key too, for `takes_key=True`: without one the noise of an image is fixed.

    Raises:
        TypeError, ValueError: a photograph that is none; several sensors; an `spp` that is no whole
            number of 1 or more; as `renderer`.

    Example:
        >>> import jax, numpy as np, smoothdiff as sd
        >>> from smoothdiff.renderers import mitsuba
        >>> scene = {"type": "scene", "ball": {"type": "sphere"}, "sky": {"type": "constant"},
        ...          "camera": {"type": "perspective"}, "integrator": {"type": "direct"}}
        >>> photo = np.ones((32, 32, 3), np.float32)
        >>> steps = mitsuba.levels(scene, "ball.translate", photo, spp=16)
        >>> [level.cost for level in steps]
        [1024.0, 4096.0, 16384.0]

    Source: own, as `coarse_to_fine`.
    """
    photo = np.asarray(photo)
    if photo.ndim != 3 or photo.shape[2] != 3:
        raise ValueError(f"photo must be of shape (height, width, 3), not {photo.shape}")
    if not (jnp.issubdtype(photo.dtype, jnp.floating) and np.all(np.isfinite(photo))):
        raise ValueError("photo must be linear RGB: finite floating-point numbers, white is one")
    if np.ndim(options.get("sensor", 0)):
        raise ValueError("a photograph is of one sensor: give its number")
    photo = photo.astype(np.float32)
    if operator.index(spp) < 1:
        raise ValueError(f"spp must be at least 1, not {spp}")

    def level(halved: int) -> Level:
        factor = 2**halved
        height, width = (side // factor for side in photo.shape[:2])
        seen = photo.reshape(height, factor, width, factor, 3).mean(axis=(1, 3))
        samples = max(spp // 4**halved, min(spp, _FEW), math.ceil(_SAMPLES / (height * width)))
        # as stratified samplers want it; the finest level is as it was asked for
        samples = math.ceil(math.sqrt(samples)) ** 2 if halved else spp
        render = renderer(scene, params, resolution=(height, width), spp=samples, **options)

        def residuals(y: PyTree, args: Any, key: Array | None = None) -> Array:
            # as long as those of the finest level, but for what is seen there alone
            return factor * (render(inputs(y), key) - seen)

        return Level(residuals, float(height * width * samples))

    count = 0
    while all(side % 2 ** (count + 1) == 0 for side in photo.shape[:2]) and (
        min(photo.shape[:2]) >> (count + 1) >= coarsest
    ):
        count += 1
    levels = [level(halved) for halved in range(count, -1, -1)]
    # a coarse one that costs more than the finest is no help
    return [each for each in levels if each.cost <= levels[-1].cost]
