"""The roughness of a metal plate from one picture, one sample a pixel (Fig. 5, 8 and 9).

As in the paper: 16 samples a pixel for the picture, 1 for the derivative, filters on logarithms.
The paper's 5 passes reach an eighth as far on its 512² texels as on 64². Three comparisons: of
filters, of filters before and after the moments, and of one moment or both.
"""

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import optax

from benchmarks import _descent
from benchmarks._descent import Configuration, Descent, Filter, Rate, adam, filtered
from benchmarks._task import Score, Task, TaskEntry
from benchmarks.scenes import plate
from benchmarks.scenes._monte_carlo import loss
from smoothdiff.filters import bilateral, cross_bilateral, laplacian

TITLE = "Roughness of a plate, one sample a pixel"
START = 0.4
SAMPLES = 1024  # of the reference
SCORED = 64  # samples of the picture by which a roughness is scored
MARKS = (25, 100)
LEVELS = (1, 2, 3, 4, 5, 6)


def build(full: bool) -> list[Task]:
    size = 512 if full else 64
    guided = partial(cross_bilateral, ndim=2, log=True)
    axes = {"levels": LEVELS, "sigma_d": (0.03, 0.1, 0.3)}
    named = lambda name, title, build: Configuration(name, title, build, axes)
    post = named("cross-bilateral", "Cross-bilateral", partial(filtered, guided))
    filters = (
        adam(),
        Configuration(
            "laplacian",
            "Laplacian",
            partial(filtered, partial(laplacian, ndim=2)),
            {"lam": (0.3, 1.0, 3.0, 10.0, 30.0, 100.0)},
        ),
        Configuration(
            "bilateral",
            "Bilateral",
            partial(filtered, partial(bilateral, ndim=2)),
            {"levels": LEVELS, "sigma_d": (0.1, 0.3, 1.0, 3.0, 10.0)},
        ),
        post,
    )
    before = partial(filtered, guided, where=("prefilter",))
    around = partial(filtered, guided, where=("prefilter", "postfilter"))
    order = (
        adam(),
        named("prefilter", "Prefilter", before),
        post._replace(title="Postfilter"),
        named("both", "Both", around),
    )
    moments = (
        post._replace(title="Both moments"),
        *(named(f"{of}-only", f"{of} only", partial(one_moment, of, guided)) for of in "mv"),
    )
    comparisons = (
        ("filters", "", filters),
        ("order", ": before or after the moments", order),
        ("moments", ": one moment filtered, or both", moments),
    )
    return [
        descent(size, configurations, name=name, title=TITLE + what)
        for name, what, configurations in comparisons
    ]


TASKS = {"texture": TaskEntry(TITLE, "descent", build)}


def descent(size: int, configurations: tuple[Configuration, ...], **named: Any) -> Descent:
    start = jnp.full((size, size), START)
    return Descent(
        problem=_descent.problem(
            gradient, partial(scene, size), start, MARKS[-1], plate.LOW, plate.HIGH
        ),
        score=Score(
            errors=errors, levels={"image error": (0.1, 0.03, 0.01), "roughness error": ()}
        ),
        start=lambda seed: start,
        seeds=5 if size > 64 else 3,
        configurations=configurations,
        rate=0.03,
        marks=MARKS,
        tuning_seeds=1,  # of a thousand texels' noise each
        pictures=pictures,
        target=lambda scene: {"roughness": scene["roughness"], "picture": scene["scored"]},
        pictured=MARKS,
        notes=f"{size} x {size} texels and pixels; 16 samples a pixel for the picture, 1 for the "
        "derivative. The image error is the squared one, relative to the start.",
        **named,
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
        "loss": loss(plate.exact(jnp.full((size, size), START), SCORED), scored),
    }


def gradient(y: jax.Array, key: jax.Array, scene: dict[str, jax.Array]) -> jax.Array:
    return plate.gradient(y, key, scene["reference"], primal=16, samples=1)


def errors(y: jax.Array, scene: dict[str, jax.Array]) -> dict[str, jax.Array]:
    image = loss(plate.exact(y, SCORED), scene["scored"]) / scene["loss"]
    roughness = jnp.sqrt(jnp.mean((y - scene["roughness"]) ** 2))
    return {"image error": image, "roughness error": roughness}


def pictures(y: jax.Array, scene: dict[str, jax.Array]) -> dict[str, Any]:
    return {
        "roughness": y,
        "picture": plate.exact(y, SCORED),
        "error of roughness": jnp.abs(y - scene["roughness"]),
    }


def one_moment(
    name: str, make: Callable[..., Filter], rate: Rate, b1: Any, b2: Any, **strength: Any
) -> optax.GradientTransformation:
    """Adam with one of its moments filtered. Its steps have no bound, so the library lacks it."""
    filter = make(**strength)

    def init(params: Any) -> Any:
        return jnp.zeros((), jnp.int32), jnp.zeros_like(params), jnp.zeros_like(params)

    def update(updates: Any, state: Any, params: Any = None) -> tuple[Any, Any]:
        step, m, v = state
        step, m, v = step + 1, b1 * m + (1 - b1) * updates, b2 * v + (1 - b2) * updates**2
        top, bottom = (filter(m, params), v) if name == "m" else (m, filter(v, params))
        time = step.astype(m.dtype)
        top, bottom = top / (1 - b1**time), bottom / (1 - b2**time)
        return -rate * top / (jnp.sqrt(bottom) + _descent.EPS), (step, m, v)

    return optax.GradientTransformation(init, update)
