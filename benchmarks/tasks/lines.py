"""Lines of 1,000 parameters: what a filter gains as a preconditioner, and by taking noise away.

What is sought is piecewise smooth. aniso is f(y) = |A (y - y*)|² with normal A, ill-conditioned,
with exact gradients (Fig. 2 of the paper); noisy is f(y) = |y - y*|², with normal noise added to
each gradient (Fig. 3).

Source: Chang et al., "Spatiotemporal Bilateral Gradient Filtering for Inverse Rendering", SIGGRAPH
Asia 2024. The signals are our own: the paper shows its signal and gives no formula.
"""

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from benchmarks._descent import Configuration, Descent, adam, filtered, problem
from benchmarks._task import Score, TaskEntry
from smoothdiff.filters import bilateral, cross_bilateral, laplacian

Scene = dict[str, jax.Array]

SIZE = 1000
PIECES = 8
SHORTEST = 0.05  # of a piece, as a share of the line
SOON, LATE = 250, 5000  # the paper's claim: who gets further by SOON than others by LATE?
NOISE = 2.0  # of a gradient; without noise it starts at about 1
LEVELS = (2, 3, 4, 5, 6, 7, 8, 9, 10)
PLAIN = Configuration(
    "gradient-descent", "Gradient descent", lambda rate, b1, b2: optax.sgd(rate), remembers=False
)
SMOOTH = Configuration(
    "laplacian",
    "Laplacian",
    partial(filtered, partial(laplacian, ndim=1)),
    {"lam": (1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)},
)
BY_ITSELF = Configuration(
    "bilateral",
    "Bilateral",
    partial(filtered, partial(bilateral, ndim=1, log=False)),
    {"levels": LEVELS, "sigma_d": (0.1, 0.3, 1.0, 3.0, 10.0, 30.0)},
)
GUIDED = Configuration(
    "cross-bilateral",
    "Cross-bilateral",
    partial(filtered, partial(cross_bilateral, ndim=1)),
    {"levels": LEVELS, "sigma_d": (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)},
)
MEMORYLESS = GUIDED._replace(
    name="memoryless", title="Cross-bilateral, memoryless", remembers=False
)


def aniso(full: bool) -> Descent:
    return _descent(
        "aniso",
        quadratic,
        lambda y, key, scene: scene["hessian"] @ (y - scene["sought"]),
        levels={"parameter error": (0.1, 0.03, 0.01), "loss": ()},
        configurations=(adam(), PLAIN, SMOOTH, GUIDED, MEMORYLESS),
        rate=0.1,
        b1=0.9,
        marks=(SOON, LATE),
        pictured=(SOON, LATE),
        notes="Errors are relative to the start. The largest curvature is about 1.",
    )


def noisy(full: bool) -> Descent:
    return _descent(
        "noisy",
        lambda seed: {"sought": jnp.asarray(signal(seed, SIZE))},
        lambda y, key, scene: 2 * (y - scene["sought"]) + NOISE * jax.random.normal(key, (SIZE,)),
        levels={"parameter error": (0.3, 0.1, 0.05)},
        configurations=(adam(), PLAIN, SMOOTH, BY_ITSELF, GUIDED, MEMORYLESS),
        rate=0.03,
        marks=(25, 50, 100, 250),
        pictured=(25, 250),
        notes=f"The error is relative to the start; normal noise of {NOISE} on each gradient.",
    )


TASKS = {
    "aniso": TaskEntry("Anisotropic quadratic on a line, exact gradients", "descent", aniso),
    "noisy": TaskEntry("Isotropic quadratic on a line, noisy gradients", "descent", noisy),
}


def signal(seed: int, size: int) -> np.ndarray:
    """A signal of pieces of random lengths, each a level with a slope and a slow wave."""
    rng = np.random.default_rng(seed)
    lengths = SHORTEST + (1 - PIECES * SHORTEST) * rng.dirichlet(np.ones(PIECES))
    x = (np.arange(size) + 0.5) / size
    piece = np.searchsorted(np.cumsum(lengths)[:-1], x)
    level, slope, phase = rng.uniform((-1, -1, 0), (1, 1, 2 * np.pi), (PIECES, 3)).T
    wave = 0.15 * np.sin(10 * x + phase[piece])
    return (level[piece] + slope[piece] * (x - 0.5) + wave).astype(np.float32)


def quadratic(seed: int) -> Scene:
    """The largest eigenvalue is about 1."""
    a = jax.random.normal(jax.random.key(seed), (SIZE, SIZE))
    hessian = jnp.matmul(a.T, a, precision="highest") / (4 * SIZE)
    return {"hessian": hessian, "sought": jnp.asarray(signal(seed, SIZE))}


def errors(y: jax.Array, scene: Scene) -> Scene:
    off = y - scene["sought"]
    found = {"parameter error": jnp.linalg.norm(off) / jnp.linalg.norm(scene["sought"])}
    return found | ({"loss": off @ scene["hessian"] @ off} if "hessian" in scene else {})


def _descent(
    name: str,
    make: Callable[[int], Scene],
    gradient: Callable[..., jax.Array],
    levels: dict[str, Sequence[float]],
    marks: Sequence[int],
    **others: Any,
) -> Descent:
    """What is sought differs from seed to seed, and is in `make(seed)`."""
    made, start = cache(make), jnp.zeros(SIZE)
    chosen = {"seed": 0}

    def choose(seed: int) -> jax.Array:
        chosen["seed"] = seed
        return made(seed)["sought"]

    return Descent(
        name=name,
        title=TASKS[name].title,
        problem=problem(gradient, lambda: made(chosen["seed"]), start, marks[-1]),
        score=Score(errors=errors, levels=levels),
        start=lambda seed: start,
        seeds=10,
        choose=choose,
        marks=marks,
        pictures=lambda y, scene: {"y": y},
        target=lambda scene: {"y": scene["sought"]},
        **others,
    )
