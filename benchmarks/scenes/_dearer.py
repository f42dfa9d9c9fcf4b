"""What a scene of Mitsuba would cost without its savings: dearer renders of the same picture."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
from jaxtyping import Array

SAVINGS = {
    "integrator": "path tracing of depth 8",
    "samples": "4 times the samples",
    "resolution": "twice the resolution",
    "updates": "the scene built anew",
    "all": "without all four",
}
PATH = {"type": "path", "max_depth": 8}

Render = Callable[[Array], Array]


def dearer(
    scene: Callable[[Any], dict[str, Any]],
    params: Mapping[str, Callable[[Array], Array]],
    *,
    resolution: int,
    spp: int,
    variant: str,
    **settings: Any,
) -> dict[str, Render]:
    """The render as it is, under "", and without each saving by its name.

    Args:
        scene: Describes the scene, given an identity transform to make others from.
        params: By name, as for `smoothdiff.renderers.mitsuba.renderer`: its value, of y.
        resolution: Pixels along a side, as it is.
        spp: Samples per pixel, as it is.
        variant: Mitsuba variant.
        settings: Of the renderer, what else it has.
    """
    import mitsuba as mi

    from smoothdiff.renderers import mitsuba

    def describe() -> dict[str, Any]:
        return scene(mi.ScalarTransform4f())

    def renderer(resolution: int = resolution, spp: int = spp, integrator: Any = None) -> Render:
        render = mitsuba.renderer(
            describe(),
            list(params),
            resolution=resolution,
            spp=spp,
            integrator=integrator,
            variant=variant,
            **settings,
        )
        return jax.jit(lambda y: render({key: value(y) for key, value in params.items()}))

    def anew(render: Render) -> Render:
        def built(y: Array) -> Array:
            # only what it costs matters: what is rendered is the scene that is there
            mi.load_dict(describe(), optimize=False)
            return render(y)

        return built

    mi.set_variant(variant)
    return {
        "": renderer(),
        "integrator": renderer(integrator=PATH),
        "samples": renderer(spp=4 * spp),
        "resolution": renderer(resolution=2 * resolution),
        "updates": anew(renderer()),  # its own, or what is there would need no update
        "all": anew(renderer(2 * resolution, 4 * spp, PATH)),
    }
