"""The papers' conjugate gradients: OurH, OurHVP and OurHVPA, by what gives the product with v.

$$ \\varepsilon = -\\frac{g \\cdot v}{v \\cdot H v}, \\quad x \\mathrel{+}= \\varepsilon v, \\quad
   r' = -g(x), \\quad \\beta = \\frac{r' \\cdot r'}{r \\cdot r}, \\quad v = r' + \\beta v $$

(HODR, eq. 4-8: Fletcher-Reeves). The step is cut to a trust region of a few sigma and found anew a
few times along the same line, with fresh samples; every few iterations, or where v does not lead
down, v starts again from the residual. Where the curvature is not positive the step goes to the
edge of the region, downhill, as a Newton step does with the Hessian modified to be positive.
"""

import itertools
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp

from benchmarks._task import Solve, Task
from benchmarks.methods import _published as published
from benchmarks.methods._flat import Flat

# the medians of table 3: OurH, OurHVP and OurHVPA, with ten entries read as nine (see _published)
RADIUS = {"hessian": 3.0, "product": 4.0, "aggregate": 4.0}  # of the trust region, in sigma
LINE_SEARCH = {"hessian": 2, "product": 2, "aggregate": 3}  # steps along a line
TOLERANCE = 1e-3  # of a step along a line, in sigma
RECOMPUTE = 10  # iterations after which v starts again

Kind = Literal["hessian", "product", "aggregate"]


@jax.jit
def _move(x, v, g, hv, radius, low, high):
    """One step along v, and its length."""
    slope, curvature = jnp.vdot(g, v), jnp.vdot(v, hv)
    length = jnp.linalg.norm(v)
    far: jax.Array = radius / jnp.maximum(length, jnp.finfo(v.dtype).tiny)
    step = -slope / jnp.where(curvature > 0, curvature, 1)
    step = jnp.where(curvature > 0, jnp.clip(step, -far, far), -jnp.sign(slope) * far)
    return jnp.clip(x + step * v, low, high), jnp.abs(step) * length


@jax.jit
def _turn(r, v, new, restart):
    """The next direction: conjugate, or the residual itself."""
    before = jnp.vdot(r, r)
    beta = jnp.where(before > 0, jnp.vdot(new, new) / jnp.where(before > 0, before, 1), 0)
    v = new + beta * v
    return jnp.where(restart | (jnp.vdot(new, v) <= 0), new, v)


def prepare(task: Task, kind: Kind) -> Solve:
    """Compiles the derivatives; the loop runs on the host, as the line search may end early."""
    flat = Flat(task)
    gradient = published.gradient(flat, aggregate=kind == "aggregate")
    if kind == "hessian":
        hessian = published.hessian(flat)
        call = lambda key, sigma, x, v: jnp.matmul(hessian.call(key, sigma, x), v)
        product = published.Derivative(jax.jit(call), hessian.evaluations)
    else:
        product = published.product(flat, aggregate=kind == "aggregate")

    def solve(y0, key, record):
        keys = (jax.random.fold_in(key, i) for i in itertools.count())
        x = jnp.asarray(flat.start(y0), flat.dtype)
        sigma = published.sigma_at(task, flat, 0)
        r = v = -gradient.call(next(keys), sigma, x)
        used = gradient.evaluations
        for i in itertools.count(1):
            sigma = published.sigma_at(task, flat, used)
            for _ in range(LINE_SEARCH[kind]):
                g = gradient.call(next(keys), sigma, x)
                hv = product.call(next(keys), sigma, x, v)
                used += gradient.evaluations + product.evaluations
                x, moved = _move(x, v, g, hv, RADIUS[kind] * sigma, flat.low, flat.high)
                if moved <= TOLERANCE * sigma:
                    break
            new = -gradient.call(next(keys), sigma, x)
            used += gradient.evaluations
            r, v = new, _turn(r, v, new, i % RECOMPUTE == 0)
            record(flat.tree(x))

    return solve


VARIANTS = {
    "our_h": ("Conjugate gradients, Hessian (OurH)", partial(prepare, kind="hessian")),
    "our_hvp": ("Conjugate gradients, product (OurHVP)", partial(prepare, kind="product")),
    "our_hvpa": ("Conjugate gradients, aggregate (OurHVPA)", partial(prepare, kind="aggregate")),
}
