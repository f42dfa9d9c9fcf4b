"""The methods of the paper on higher-order rendering, at one setting for all tasks.

Table 3 of Stochastic Gradient Estimation for Higher-order Differentiable Rendering (HODR) has a
setting for each task, chosen as the best. As here one serves all tasks, it is the median over the
table's nine tasks, in units of the first sigma: two antithetic pairs, and a sigma that ends at 2 %
and falls linearly (appendix L) with the evaluations used. The aggregate sampler draws six pairs, as
the table has it for Box2 and Box10: with two it finds little. Nothing is subtracted.

OurG is the importance-sampled gradient (eq. 17) with Adam, the same as for all first-order methods
here. OurH, OurHVP and OurHVPA are conjugate gradients, by what gives the product with v.

$$ \\varepsilon = -\\frac{g \\cdot v}{v \\cdot H v}, \\quad x \\mathrel{+}= \\varepsilon v, \\quad
   r' = -g(x), \\quad \\beta = \\frac{r' \\cdot r'}{r \\cdot r}, \\quad v = r' + \\beta v $$

(eq. 4-8: Fletcher-Reeves). The step is cut to a trust region of a few sigma and found anew a
few times along the same line, with fresh samples; every few iterations, or where v does not lead
down, v starts again from the residual. Where the curvature is not positive the step goes to the
edge of the region, downhill, as a Newton step does with the Hessian modified to be positive.
"""

import itertools
from collections.abc import Callable
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp

import smoothdiff as sd
from benchmarks._task import MethodEntry, Problem, Solve
from benchmarks.methods._adam import adam
from benchmarks.methods._flat import Flat

PER_ELEMENT = 4  # samples
AGGREGATE = 12  # samples for all elements together
SIGMA_END = 0.02  # of the problem's sigma
SHIFT = 1 / 3  # epsilon |v| of eq. 8, in units of sigma, as in the authors' code
# the medians of table 3: OurH, OurHVP and OurHVPA, with ten entries read as nine
RADIUS = {"hessian": 3.0, "product": 4.0, "aggregate": 4.0}  # of the trust region, in sigma
LINE_SEARCH = {"hessian": 2, "product": 2, "aggregate": 3}  # steps along a line
TOLERANCE = 1e-3  # of a step along a line, in sigma
RECOMPUTE = 10  # iterations after which v starts again

Kind = Literal["hessian", "product", "aggregate"]


class Derivative(NamedTuple):
    """A derivative of the smoothed loss of a flat vector, compiled, and what it costs."""

    call: Callable[..., jax.Array]
    evaluations: int


def sampled_gradient(flat: Flat, *, aggregate: bool) -> Derivative:
    """`(key, sigma, x) -> vector`, eq. 17: elementwise or aggregate importance sampling."""
    call = jax.jit(lambda key, sigma, x: _smooth_grad(flat, sigma, aggregate)(key, x))
    return Derivative(call, AGGREGATE if aggregate else PER_ELEMENT * flat.size)


def gradient_difference(flat: Flat, *, aggregate: bool) -> Derivative:
    """`(key, sigma, x, v) -> vector`, eq. 8 and 23: the difference of two sampled gradients.

    Both see the same random numbers; drawn independently, their difference is noise.
    """

    @jax.jit
    def call(key, sigma, x, v):
        grad = _smooth_grad(flat, sigma, aggregate)
        length = jnp.maximum(jnp.linalg.norm(v), jnp.finfo(v.dtype).tiny)
        along = sd.difference_hvp(grad, SHIFT)(key, x, v * (sigma / length))
        return along * (length / sigma)

    return Derivative(call, 2 * sampled_gradient(flat, aggregate=aggregate).evaluations)


def hessian_product(flat: Flat) -> Derivative:
    """The same by a Hessian, eq. 20, elementwise: n (n + 1) / 2 sets of samples."""

    @jax.jit
    def call(key, sigma, x, v):
        sampler = sd.Importance(2)
        options = {"num_samples": PER_ELEMENT, "sampler": sampler, "baseline": "none"}
        return jnp.matmul(sd.smooth_hessian(flat.loss, sigma, **options)(key, x), v)

    return Derivative(call, PER_ELEMENT * flat.size * (flat.size + 1) // 2)


def sigma_at(flat: Flat, evaluations: int) -> jax.Array:
    """The sigma after so many evaluations, of those that the problem allows."""
    used = min(evaluations / flat.problem.budget.evaluations, 1)
    return jnp.asarray(flat.problem.sigma * (1 - (1 - SIGMA_END) * used), flat.dtype)


def _smooth_grad(flat: Flat, sigma: jax.Array, aggregate: bool) -> Callable:
    if aggregate:
        num_samples, sampler = AGGREGATE, sd.Aggregate(1, share=0.0)
    else:
        num_samples, sampler = PER_ELEMENT, sd.Importance(1)
    options = {"num_samples": num_samples, "sampler": sampler, "baseline": "none"}
    return sd.smooth_grad(flat.loss, sigma, **options)


def our_gradient(problem: Problem) -> Solve:
    """A set of samples for each parameter."""
    flat = Flat(problem)
    call, evaluations = sampled_gradient(flat, aggregate=False)
    gradient = lambda key, i, x: call(key, sigma_at(flat, i * evaluations), x)
    return adam(flat, gradient, evaluations)


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


def conjugate_gradients(problem: Problem, kind: Kind) -> Solve:
    """Compiles the derivatives; the loop runs on the host, as the line search may end early."""
    flat, aggregate = Flat(problem), kind == "aggregate"
    gradient = sampled_gradient(flat, aggregate=aggregate)
    if kind == "hessian":
        product = hessian_product(flat)
    else:
        product = gradient_difference(flat, aggregate=aggregate)

    def solve(y0, key, record):
        keys = (jax.random.fold_in(key, i) for i in itertools.count())
        x = jnp.asarray(flat.start(y0), flat.dtype)
        sigma = sigma_at(flat, 0)
        r = v = -gradient.call(next(keys), sigma, x)
        used = gradient.evaluations
        for i in itertools.count(1):
            sigma = sigma_at(flat, used)
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


METHODS = {
    "our_gradient": MethodEntry(
        "Importance-sampled gradient, Adam (OurG)", ("scene",), our_gradient
    ),
    "our_h": MethodEntry(
        "Conjugate gradients, Hessian (OurH)", (), partial(conjugate_gradients, kind="hessian")
    ),
    "our_hvp": MethodEntry(
        "Conjugate gradients, product (OurHVP)", (), partial(conjugate_gradients, kind="product")
    ),
    "our_hvpa": MethodEntry(
        "Conjugate gradients, aggregate (OurHVPA)",
        ("scene", "large", "function"),
        partial(conjugate_gradients, kind="aggregate"),
    ),
}
