"""Shadow: where is a sphere that is outside the picture, given the shadow that it casts into it?

After the Shadow task of higher-order differentiable rendering (section 4.1).
"""

from typing import Any

import jax.numpy as jnp

from benchmarks._task import Budget, Score, Task, entry
from benchmarks.scenes import shadow
from benchmarks.tasks._scene_task import scene_task


def build(full: bool, spp: int = 4, **named: Any) -> Task:
    """Quick: 32 x 32 pixels; full: 64 x 64. `spp` are samples of a pixel."""
    from smoothdiff.renderers.mitsuba import available

    resolution, exact_spp = (64, 32) if full else (32, 64)
    variant = "llvm_ad_rgb" if available("llvm_ad_rgb") else "scalar_rgb"
    image, photo = shadow.make(resolution, exact_spp, variant)
    reference = jnp.asarray(shadow.REFERENCE)
    exact = image(reference)
    return scene_task(
        full,
        scene=shadow.scene,
        params=shadow.PARAMS,
        reference=shadow.REFERENCE,
        bounds=shadow.BOUNDS,
        start_box=shadow.START_BOX,
        sigma=shadow.SIGMA,
        budget=Budget(evaluations=600, seconds=8),
        resolution=resolution,
        spp=spp,
        variant=variant,
        ad_integrator={"type": "direct_projective"},
        photo=photo,
        score=Score(reference, lambda y: jnp.mean((image(y) - exact) ** 2), image),
        **named,
    )


TASKS = entry(
    "scene", build, "shadow", "Shadow: position of an unseen sphere", parameters=2, plateaus=True
)
