"""Where is a sphere that is outside the picture? Its shadow tells; Mitsuba 3 as a black box."""

import jax
import jax.numpy as jnp

from benchmarks._task import Budget, NotAble, Task

TITLE = "Shadow: position of an unseen sphere"


def build(full: bool, spp: int = 4) -> Task:
    """Quick: 32 x 32 pixels and 5 starts; full: 64 x 64 and 20. `spp` are samples of a pixel."""
    from benchmarks.scenes import shadow
    from benchmarks.scenes._dearer import dearer
    from smoothdiff.renderers.mitsuba import available

    resolution, exact_spp = (64, 32) if full else (32, 64)
    variant = "llvm_ad_rgb" if available("llvm_ad_rgb") else "scalar_rgb"
    render, photo = shadow.make(resolution, spp, variant)
    image, _ = shadow.make(resolution, exact_spp, variant)
    reference = jnp.asarray(shadow.REFERENCE)
    exact = image(reference)

    def start(seed):
        low, high = shadow.START_BOX
        return jax.random.uniform(jax.random.key(seed), reference.shape, minval=low, maxval=high)

    def native_ad():
        if variant == "scalar_rgb":
            raise NotAble("needs libllvm >= 17, for Mitsuba's variant llvm_ad_rgb")
        return shadow.native_ad(resolution, spp, photo, variant)

    def without_savings():
        return dearer(
            lambda world: shadow.scene_dict(resolution),
            {"ball.translate": lambda y: jnp.insert(y, 1, 0.0)},
            resolution=resolution,
            spp=spp,
            variant=variant,
        )

    return Task(
        name="shadow",
        title=TITLE,
        loss=lambda y: jnp.mean((render(y) - photo) ** 2),
        exact_loss=lambda y: jnp.mean((image(y) - exact) ** 2),
        start=start,
        reference=reference,
        bounds=tuple(map(jnp.asarray, shadow.BOUNDS)),
        sigma=shadow.SIGMA,
        budget=Budget(evaluations=600, seconds=8),
        seeds=20 if full else 5,
        image=image,
        residuals=lambda y: render(y) - photo,
        native_ad=native_ad,
        dearer=without_savings,
        notes=f"{resolution} x {resolution} pixels, {spp} samples per pixel, {variant}",
    )
