"""The roughness of a metal plate from one picture, one sample a pixel (Fig. 5, 8 and 9).

As in the paper: 16 samples a pixel for the picture, 1 for the derivative, filters on logarithms.
The passes are tuned: the paper's 5 reach a quarter as far on its 512² texels as on 128². Three
comparisons: of filters, of filters before and after the moments, and of one moment or both.
"""

from collections.abc import Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import optax
from optax import GradientTransformation as Transformation

import smoothdiff as sd
from benchmarks.descents import (
    EPS,
    Build,
    Configuration,
    Descent,
    Filter,
    Optimiser,
    Rate,
    denoising,
    keep_within,
    postfiltered,
    prefiltered,
    variants,
)
from benchmarks.scenes import plate

TITLE = "Roughness of a plate, one sample a pixel"
START = 0.4
SAMPLES = 1024  # of the reference
SCORED = 64  # samples of the picture by which a roughness is scored
RATES = (0.003, 0.01, 0.03, 0.1)
MARKS = (10, 25, 50, 100)
DECAY = (0.2,)  # b1, the paper's best


def build(full: bool) -> list[Descent]:
    size = 512 if full else 128
    guided = {f"levels={levels}": cross(levels) for levels in (3, 4, 5)}
    adam = Configuration("adam", "Adam", tried({"": None}, b1s=(0.2, 0.5, 0.9)))
    post = Configuration("cross-bilateral", "Cross-bilateral", tried(guided))
    filters = (
        adam,
        Configuration("laplacian", "Laplacian", tried(smooth())),
        Configuration("bilateral", "Bilateral", tried(by_itself())),
        post,
    )
    halved = {f"levels={levels}": cross(levels) for levels in (2, 3)}
    order = (
        adam,
        Configuration("prefilter", "Prefilter", tried(guided, prefiltered)),
        post._replace(title="Postfilter"),
        Configuration("both", "Both, of half the passes", tried(halved, around)),
    )
    moments = (
        post._replace(title="Both moments"),
        *(
            Configuration(f"{name}-only", f"{name} only", tried(guided, partial(one_moment, name)))
            for name in ("m", "v")
        ),
    )
    return [
        _descent("filters", TITLE, filters, size, also=partial(denoise, size)),
        _descent("order", f"{TITLE}: before or after the moments", order, size),
        _descent("moments", f"{TITLE}: one moment filtered, or both", moments, size),
    ]


def _descent(name: str, title: str, configurations: tuple, size: int, **others: Any) -> Descent:
    return Descent(
        name=name,
        title=title,
        scene=lambda seed: scene(size),
        start=lambda seed, scene: jnp.full((size, size), START),
        gradient=lambda y, key, scene: plate.gradient(
            y, key, scene["reference"], primal=16, samples=1
        ),
        errors=errors,
        score="image error",
        configurations=configurations,
        rates=RATES,
        marks=MARKS,
        levels=(0.1, 0.03, 0.01),
        seeds=5,
        tuning_seeds=1,  # of a thousand texels' noise each
        pictures=pictures,
        target=lambda scene: {
            "roughness": scene["roughness"],
            "picture": plate.exact(scene["roughness"], SCORED),
        },
        pictured=(25, 100),
        notes=f"{size} x {size} texels and pixels; 16 samples a pixel for the picture, 1 for the "
        "derivative. The image error is the squared one, relative to the start.",
        **others,
    )


@cache
def scene(size: int) -> dict[str, jax.Array]:
    """What is sought, its picture, and what scores need."""
    roughness = jnp.asarray(plate.texture(size))
    scored = plate.exact(roughness, SCORED)
    return {
        "roughness": roughness,
        "reference": plate.exact(roughness, SAMPLES),
        "scored": scored,
        "loss": plate.loss(plate.exact(jnp.full((size, size), START), SCORED), scored),
    }


def errors(y: jax.Array, scene: dict[str, jax.Array]) -> dict[str, jax.Array]:
    image = plate.loss(plate.exact(y, SCORED), scene["scored"]) / scene["loss"]
    roughness = jnp.sqrt(jnp.mean((y - scene["roughness"]) ** 2))
    return {"image error": image, "roughness error": roughness}


def pictures(y: jax.Array, scene: dict[str, jax.Array]) -> dict[str, Any]:
    return {
        "roughness": y,
        "picture": plate.exact(y, SCORED),
        "error of roughness": jnp.abs(y - scene["roughness"]),
    }


def cross(levels: int, sigma_d: float = 0.1) -> Filter:
    return sd.filters.cross_bilateral(sigma_d, levels, ndim=2, log=True)


def smooth() -> dict[str, Filter]:
    return {f"lam={lam}": sd.filters.laplacian(lam, ndim=2) for lam in (1, 3, 10)}


def by_itself() -> dict[str, Filter]:
    return {f"sigma_d={s}": sd.filters.bilateral(s, 3, ndim=2) for s in (0.3, 1.0, 3.0)}


def tried(
    filters: Mapping[str, Filter | None],
    build: Build = postfiltered,
    b1s: Sequence[float] = DECAY,
) -> dict[str, Optimiser]:
    """The variants of a filter; the roughness stays in its range."""

    def bounded(rate: Rate, b1: float, b2: float, filter: Filter | None) -> Transformation:
        return optax.chain(build(rate, b1, b2, filter), keep_within(plate.LOW, plate.HIGH))

    return variants(b1s, filters, bounded)


def around(rate: Rate, b1: float, b2: float, filter: Filter) -> Transformation:
    """Adam with its gradients and its moments filtered."""
    return sd.filtered_adam(rate, b1, b2, eps=EPS, prefilter=filter, postfilter=filter)


def one_moment(name: str, rate: Rate, b1: float, b2: float, filter: Filter) -> Transformation:
    """Adam with one of its moments filtered. Its steps have no bound, so the library lacks it."""

    def init(params: Any) -> Any:
        return jnp.zeros((), jnp.int32), jnp.zeros_like(params), jnp.zeros_like(params)

    def update(updates: Any, state: Any, params: Any = None) -> tuple[Any, Any]:
        step, m, v = state
        step, m, v = step + 1, b1 * m + (1 - b1) * updates, b2 * v + (1 - b2) * updates**2
        top, bottom = (filter(m, params), v) if name == "m" else (m, filter(v, params))
        time = step.astype(m.dtype)
        top, bottom = top / (1 - b1**time), bottom / (1 - b2**time)
        return -rate * top / (jnp.sqrt(bottom) + EPS), (step, m, v)

    return Transformation(init, update)


def denoise(size: int, folder: Path) -> dict[str, Any]:
    """Draws a gradient on the way, before and after filters."""
    found = scene(size)
    on_the_way = START + 0.5 * (found["roughness"] - START)
    gradient = jax.jit(
        lambda key, primal, samples: plate.gradient(
            on_the_way, key, found["reference"], primal=primal, samples=samples
        ),
        static_argnums=(1, 2),
    )
    exact = jnp.mean(jnp.stack([gradient(jax.random.key(i), 64, 64) for i in range(8)]), 0)
    guided = {f"sigma_d={s}": cross(5, s) for s in (0.03, 0.1)}
    return denoising(
        lambda key: gradient(key, 16, 1),
        exact,
        on_the_way,
        {"Laplacian": smooth(), "Bilateral": by_itself(), "Cross-bilateral": guided},
        folder / "denoising.png",
    )
