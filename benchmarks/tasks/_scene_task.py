"""The task of finding the parameters of a scene of Mitsuba from a picture of it.

A scene's module says what is in the picture, what is varied, what is sought and where to start. The
photograph that is to be matched has many samples and other noise than the picture.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from benchmarks._task import Budget, NativeAD, Problem, Score, Task, entry
from benchmarks.scenes.mitsuba_scene import (
    VARIANT,
    Describe,
    Description,
    Params,
    dearer,
    fidelities,
    picture,
)

EXACT, PHOTO = 9, 64  # times the samples, for the score and for the photograph


def scene_task(
    full: bool,
    *,
    scene: Describe,
    params: Params,
    reference: ArrayLike,
    bounds: tuple[ArrayLike, ArrayLike],
    start_box: tuple[ArrayLike, ArrayLike],
    sigma: float,
    budget: Budget,
    seeds: tuple[int, int] = (5, 20),
    resolution: int = 32,
    spp: int = 4,
    variant: str = VARIANT,
    support: Any = None,
    ad_integrator: Description | None = None,
    photo: Float[np.ndarray, "height width 3"] | None = None,
    score: Score | None = None,
    **named: Any,
) -> Task:
    """The task. Its loss is the mean squared difference of the pictures; others as in `Task`.

    Args:
        scene: Describes the scene.
        params: What is varied.
        start_box: (low, high): starts are uniform in between.
        seeds: Quick and full.
        resolution: Pixels along a side.
        spp: Samples per pixel, a square.
        variant: Of Mitsuba.
        ad_integrator: What Mitsuba differentiates the picture with, or None where it cannot.
        photo: The photograph, or None for one with 64 times the samples.
        score: How y is scored, or None for pictures with 9 times the samples.
    """
    pictured = partial(picture, scene, params, variant, resolution=resolution)
    sought, low, high, start_low, start_high = (
        jnp.asarray(y, jnp.float32) for y in (reference, *bounds, *start_box)
    )
    render = pictured(spp=spp)
    if photo is None:
        photo = np.asarray(pictured(spp=PHOTO * spp, seed=1)(sought))

    if score is None:
        image, again = pictured(spp=EXACT * spp), pictured(spp=EXACT * spp, seed=2)
        exact, exact_again = image(sought), again(sought)

        def exact_loss(y: Array) -> Array:
            # other noise in each factor: in the mean it vanishes, where squares would add it up
            product = (image(y) - exact) * (again(y) - exact_again)
            return jnp.maximum(jnp.mean(product), 0)

        score = Score(sought, exact_loss, image)

    def native_ad() -> NativeAD:
        from benchmarks.scenes._mitsuba_ad import value_and_grad

        assert ad_integrator is not None
        return value_and_grad(scene, params, ad_integrator, photo, spp)

    uniform = partial(jax.random.uniform, shape=sought.shape, minval=start_low, maxval=start_high)
    return Task(
        problem=Problem(
            bounds=(low, high),
            sigma=sigma,
            budget=budget,
            residuals=lambda y: render(y) - photo,
            keyed=lambda y, key: render(y, key) - photo,
            support=support,
            native_ad=native_ad if ad_integrator else None,
        ),
        score=score,
        start=lambda seed: uniform(jax.random.key(seed)),
        seeds=seeds[full],
        dearer=lambda: dearer(scene, params, resolution, spp, variant),
        fidelities=partial(fidelities, scene, params, variant, sought),
        notes=f"{resolution} x {resolution} pixels, {spp} samples per pixel, {variant}",
        **named,
    )


scene_entry = partial(entry, "scene", scene_task)
