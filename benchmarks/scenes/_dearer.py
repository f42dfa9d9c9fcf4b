"""What a scene of Mitsuba would cost without its savings: dearer renders of the same picture."""

from typing import Any

import jax
from jaxtyping import Array

from benchmarks.scenes.mitsuba_scene import Describe, Params, Picture, picture

SAVINGS = {
    "integrator": "path tracing of depth 8",
    "samples": "4 times the samples",
    "resolution": "twice the resolution",
    "updates": "the scene built anew",
    "all": "without all four",
}
PATH = {"type": "path", "max_depth": 8}


def dearer(
    scene: Describe, params: Params, resolution: int, spp: int, variant: str
) -> dict[str, Picture]:
    """The render as it is, under "", and without each saving by its name.

    Args:
        scene: As for `picture`.
        params: Likewise.
        resolution: Pixels along a side, as it is.
        spp: Samples per pixel, as it is.
        variant: Of Mitsuba.
    """

    def render(**changes: Any) -> Picture:
        usual = {"resolution": resolution, "spp": spp}
        return jax.jit(picture(scene, params, variant, **(usual | changes)))

    def anew(render: Picture) -> Picture:
        import mitsuba as mi

        def built(y: Array) -> Array:
            # only what it costs matters: what is rendered is the scene that is there
            mi.load_dict(scene(mi.ScalarTransform4f()), optimize=False)
            return render(y)

        return built

    return {
        "": render(),
        "integrator": render(integrator=PATH),
        "samples": render(spp=4 * spp),
        "resolution": render(resolution=2 * resolution),
        "updates": anew(render()),  # its own, or what is there would need no update
        "all": anew(render(resolution=2 * resolution, spp=4 * spp, integrator=PATH)),
    }
