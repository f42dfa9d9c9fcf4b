"""The methods of the paper on higher-order rendering, at one setting for all tasks.

Table 3 of Stochastic Gradient Estimation for Higher-order Differentiable Rendering (HODR) has a
setting for each task, chosen as the best. As here one serves all tasks, it is the median over the
table's nine tasks, in units of the first sigma: two antithetic pairs, and a sigma that ends at 2 %
and falls linearly (appendix L) with the evaluations used. The aggregate sampler draws six pairs, as
the table has it for Box2 and Box10: with two it finds little. Nothing is subtracted.

OurG is the importance-sampled gradient (eq. 17) with Adam, the same as for all first-order methods
here. OurHVPA is conjugate gradients with sampled products with v.

$$ \\varepsilon = -\\frac{g \\cdot v}{v \\cdot H v}, \\quad x \\mathrel{+}= \\varepsilon v, \\quad
   r' = -g(x), \\quad \\beta = \\frac{r' \\cdot r'}{r \\cdot r}, \\quad v = r' + \\beta v $$

(eq. 4-8: Fletcher-Reeves). The step is cut to a trust region of a few sigma and found anew a
few times along the same line, with fresh samples; every few iterations, or where v does not lead
down, v starts again from the residual. Where the curvature is not positive the step goes to the
edge of the region, downhill, as a Newton step does with the Hessian modified to be positive.
"""

import itertools

import jax
import jax.numpy as jnp

import smoothdiff as sd
from benchmarks._task import MethodEntry, Problem, Solve
from benchmarks.methods._flat import Flat
from benchmarks.methods.adam import adam

PER_ELEMENT = 4  # samples
AGGREGATE = 12  # samples for all elements together
SIGMA_END = 0.02  # of the problem's sigma
SHIFT = 1 / 3  # epsilon |v| of eq. 8, in units of sigma, as in the authors' code
RADIUS = 4.0  # of the trust region, in sigma; this and the next are the medians of table 3
LINE_SEARCH = 3  # steps along a line
TOLERANCE = 1e-3  # of a step along a line, in sigma
RECOMPUTE = 10  # iterations after which v starts again


def sigma_at(flat: Flat, evaluations: int) -> jax.Array:
    """The sigma after so many evaluations, of those that the problem allows."""
    used = min(evaluations / flat.problem.budget.evaluations, 1)
    return jnp.asarray(flat.problem.sigma * (1 - (1 - SIGMA_END) * used), flat.dtype)


def our_gradient(problem: Problem) -> Solve:
    """A set of samples for each parameter."""
    flat = Flat(problem)
    evaluations = PER_ELEMENT * flat.size
    options = {"num_samples": PER_ELEMENT, "baseline": "none"}
    slope = jax.jit(lambda key, sigma, x: sd.Importance(1)(flat.loss, sigma, **options)(key, x))
    gradient = lambda key, i, x: slope(key, sigma_at(flat, i * evaluations), x)
    return adam(flat, gradient, evaluations)


class Aggregate:
    """Derivatives of the smoothed loss of a flat vector by the aggregate sampler, compiled.

    Attributes:
        gradient: `(key, sigma, x) -> vector`, eq. 17.
        product: `(key, sigma, x, v) -> vector`, eq. 8 and 23: the difference of two gradients, that
            see the same random numbers; drawn independently, their difference is noise.
    """

    def __init__(self, flat: Flat):
        sampler = sd.Aggregate(1, share=0.0)
        options = {"num_samples": AGGREGATE, "sampler": sampler, "baseline": "none"}
        smooth_grad = lambda sigma: sd.smooth_grad(flat.loss, sigma, **options)

        @jax.jit
        def product(key, sigma, x, v):
            length = jnp.maximum(jnp.linalg.norm(v), jnp.finfo(v.dtype).tiny)
            shifted = sd.difference_hvp(smooth_grad(sigma), SHIFT)
            return shifted(key, x, v * (sigma / length)) * (length / sigma)

        self.gradient = jax.jit(lambda key, sigma, x: smooth_grad(sigma)(key, x))
        self.product = product


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


def conjugate_gradients(problem: Problem) -> Solve:
    """Compiles the derivatives; the loop runs on the host, as the line search may end early."""
    flat = Flat(problem)
    of = Aggregate(flat)

    def solve(y0, key, record):
        keys = (jax.random.fold_in(key, i) for i in itertools.count())
        x = jnp.asarray(flat.start(y0), flat.dtype)
        sigma = sigma_at(flat, 0)
        r = v = -of.gradient(next(keys), sigma, x)
        used = AGGREGATE
        for i in itertools.count(1):
            sigma = sigma_at(flat, used)
            for _ in range(LINE_SEARCH):
                g = of.gradient(next(keys), sigma, x)
                hv = of.product(next(keys), sigma, x, v)
                used += 3 * AGGREGATE
                x, moved = _move(x, v, g, hv, RADIUS * sigma, flat.low, flat.high)
                if moved <= TOLERANCE * sigma:
                    break
            new = -of.gradient(next(keys), sigma, x)
            used += AGGREGATE
            r, v = new, _turn(r, v, new, i % RECOMPUTE == 0)
            record(flat.tree(x))

    return solve


METHODS = {
    "our_gradient": MethodEntry(
        "Importance-sampled gradient, Adam (OurG)", ("scene",), our_gradient
    ),
    "our_hvpa": MethodEntry(
        "Conjugate gradients, aggregate (OurHVPA)",
        ("scene", "large", "function"),
        conjugate_gradients,
    ),
}
