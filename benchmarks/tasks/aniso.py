"""A line of 1,000 parameters under an ill-conditioned quadratic, with exact gradients (Fig. 2).

f(y) = |A (y - y*)|² with normal A, y* piecewise smooth. Gradients have no noise, so what a filter
gains here it gains as a preconditioner.
"""

import jax
import jax.numpy as jnp
import optax

import smoothdiff as sd
from benchmarks.descents import Configuration, Descent, variants
from benchmarks.scenes import piecewise

TITLE = "Anisotropic quadratic on a line, exact gradients"
SIZE = 1000
SOON, LATE = 250, 5000  # the paper's claim: who gets further by SOON than others by LATE?
RATES = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0)


def build(full: bool) -> Descent:
    b1s = (0.2, 0.5, 0.9, 0.95, 0.98) if full else (0.9, 0.95)
    smooth = {f"lam={lam}": sd.filters.laplacian(lam, ndim=1) for lam in (10, 100)}
    guided = {
        f"sigma_d={sigma}": sd.filters.cross_bilateral(sigma, 5, ndim=1) for sigma in (0.03, 0.1)
    }
    return Descent(
        name="aniso",
        title=TITLE,
        scene=scene,
        start=lambda seed, scene: jnp.zeros(SIZE),
        gradient=lambda y, key, scene: scene["hessian"] @ (y - scene["sought"]),
        errors=errors,
        score="parameter error",
        configurations=(
            Configuration("adam", "Adam", variants(b1s, {"": None})),
            Configuration(
                "gradient-descent", "Gradient descent", {"": lambda rate: optax.sgd(rate)}
            ),
            Configuration("laplacian", "Laplacian", variants(b1s, smooth)),
            Configuration("cross-bilateral", "Cross-bilateral", variants(b1s, guided), SOON),
            Configuration(
                "memoryless", "Cross-bilateral, memoryless", variants((0.0,), guided), SOON
            ),
        ),
        rates=RATES,
        marks=(25, 100, SOON, 1000, LATE),
        levels=(0.1, 0.03, 0.01),
        seeds=10,
        pictures=lambda y, scene: {"y": y},
        target=lambda scene: {"y": scene["sought"]},
        pictured=(SOON, LATE),
        notes="Errors are relative to the start. The cross-bilateral configurations are tuned for "
        f"iteration {SOON}, the others for iteration {LATE}. The largest curvature is about 1.",
    )


def scene(seed: int) -> dict[str, jax.Array]:
    """The quadratic of a seed; its largest eigenvalue is about 1."""
    a = jax.random.normal(jax.random.key(seed), (SIZE, SIZE))
    hessian = jnp.matmul(a.T, a, precision="highest") / (4 * SIZE)
    return {"hessian": hessian, "sought": jnp.asarray(piecewise.signal(seed, SIZE))}


def errors(y: jax.Array, scene: dict[str, jax.Array]) -> dict[str, jax.Array]:
    off = y - scene["sought"]
    return {
        "parameter error": jnp.linalg.norm(off) / jnp.linalg.norm(scene["sought"]),
        "loss": off @ scene["hessian"] @ off,
    }
