"""The methods of the paper on higher-order rendering, by the rules that its authors ran them by.

Stochastic Gradient Estimation for Higher-order Differentiable Rendering (Wang, Fischer, Ritschel
2024). They are named after their authors: Fischer-FR22 and Wang-G are gradients with Adam at a
constant rate, Wang-H, Wang-HVP and Wang-HVPA conjugate gradients with sampled Hessians, with
products by elements, and with aggregate ones.

$$ \\varepsilon = -\\frac{g \\cdot v}{v \\cdot H v}, \\quad x \\mathrel{+}= \\varepsilon v, \\quad
   r' = -g(x), \\quad \\beta = \\frac{r' \\cdot r'}{r \\cdot r}, \\quad v = r' + \\beta v $$

(eq. 4-8: Fletcher-Reeves). Where the curvature is not positive it is taken as one, so that the step
is as small as the slope is. The step is cut to the trust region, and found anew along the same line
with fresh samples until it is small or has been found often enough. After some iterations, or where
v does not lead down, v starts again from the residual. The two ends of a product are drawn
independently, a third of sigma away. Sigma falls linearly. There are no bounds but the problem's.

All lengths are in units of the problem's sigma, which is the first one. Here one setting serves all
tasks: the median over the nine tasks of the paper's Table 3. `benchmarks papers` has the table's
own, on the paper's tasks; `run --tuned` the best of a grid.
"""

import itertools
from collections.abc import Callable
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import optax

import smoothdiff as sd
from benchmarks._task import MethodEntry, Problem, Solve
from benchmarks.methods._flat import Flat
from benchmarks.methods._pairs import Slope, aggregate, by_element, fischer

SLOPES = {"fischer": fischer, "elements": by_element, "aggregate": aggregate}
SHIFT = 1 / 3  # epsilon |v| of eq. 8, in units of sigma
TOLERANCE = 1e-3  # of a squared step along a line
# medians of Table 3
PAIRS, SIGMA_END, RATE, TRUST, LINE_SEARCH, RECOMPUTE = 2, 0.02, 0.04, 4.0, 3, 10


def falling(flat: Flat, end: float, iterations: float) -> Callable[[float], jax.Array]:
    """Sigma after so many iterations; afterwards it stays."""
    left = lambda i: 1 - (1 - end) * min(i / max(iterations, 1), 1)
    return lambda i: jnp.asarray(flat.problem.sigma * left(i), flat.dtype)


def first_order(
    problem: Problem,
    slope: Literal["fischer", "elements"],
    *,
    pairs: int = PAIRS,
    rate: float = RATE,
    sigma_end: float = SIGMA_END,
    fall: int | None = None,
) -> Solve:
    """Adam at a constant rate.

    Args:
        problem: The problem.
        slope: How the gradient is sampled.
        pairs: Of samples, for each element that is sampled.
        rate: The learning rate, in units of sigma.
        sigma_end: Of the first sigma.
        fall: Iterations after which sigma is there; by default those of the budget.
    """
    flat = Flat(problem)
    evaluations = 2 * pairs * (1 if slope == "fischer" else flat.size)
    sigma = falling(flat, sigma_end, fall or problem.budget.evaluations / evaluations)
    gradient = SLOPES[slope](flat, pairs)
    optim = optax.adam(rate * problem.sigma)

    @jax.jit
    def move(key, width, x, state):
        updates, state = optim.update(gradient(key, width, x), state, x)
        return flat.clip(x + updates), state

    return flat.iterate(lambda key, i, x, state: move(key, sigma(i), x, state), optim.init)


def conjugate_gradients(
    problem: Problem,
    second: Literal["hessian", "elements", "aggregate"],
    *,
    pairs: int = PAIRS,
    trust: float = TRUST,
    line_search: int = LINE_SEARCH,
    tolerance: float = TOLERANCE,
    recompute: int = RECOMPUTE,
    sigma_end: float = SIGMA_END,
    fall: int | None = None,
) -> Solve:
    """Compiles the derivatives; the loop runs on the host, as the line search may end early.

    Args:
        problem: The problem.
        second: A sampled Hessian, or products as differences of gradients by elements or aggregate.
        pairs: Of samples, for each element that is sampled.
        trust: The longest step along a line, in units of sigma, and of the first one with Hessians.
        line_search: Steps along a line.
        tolerance: Of a squared step, that ends it, in units of the first sigma squared.
        recompute: Iterations after which v starts again.
        sigma_end, fall: As for `first_order`. By default sigma falls over the evaluations.
    """
    flat, first = Flat(problem), problem.sigma
    slope = SLOPES["aggregate" if second == "aggregate" else "elements"](flat, pairs)
    product = _hessian(flat, pairs) if second == "hessian" else _difference(slope)
    n = 1 if second == "aggregate" else flat.size
    sets = n * (n + 1) // 2 if second == "hessian" else 2 * n
    of_gradient, of_step = 2 * pairs * n, 2 * pairs * (n + sets)
    sigma = falling(flat, sigma_end, fall or 1)

    @jax.jit
    def along(key, width, x, v):
        """A step along v, and its length squared."""
        for_product, for_slope = jax.random.split(key)
        hv, g = product(for_product, width, x, v), slope(for_slope, width, x)
        return _move(flat, x, v, g, hv, trust * (first if second == "hessian" else width))

    residual = jax.jit(lambda key, width, x: -slope(key, width, x))

    def solve(y0, key, record):
        keys = (jax.random.fold_in(key, i) for i in itertools.count())
        x = jnp.asarray(flat.start(y0), flat.dtype)
        r = v = residual(next(keys), sigma(0), x)
        used, since = of_gradient, 0
        for i in itertools.count():
            width = sigma(i if fall else used / problem.budget.evaluations)
            for _ in range(line_search):
                x, squared = along(next(keys), width, x, v)
                used += of_step
                if squared <= tolerance * first**2:
                    break
            new = residual(next(keys), width, x)
            used, since = used + of_gradient, since + 1
            v, again = _turn(r, v, new, since >= recompute)
            r, since = new, 0 if again else since
            record(flat.tree(x))

    return solve


def _hessian(flat: Flat, pairs: int):
    """(key, sigma, x, v) -> H v by a whole sampled Hessian."""
    hessian, options = sd.Importance(2), {"num_samples": 2 * pairs, "baseline": "none"}
    return lambda key, sigma, x, v: hessian(flat.loss, sigma, **options)(key, x) @ v


def _difference(slope: Slope):
    """(key, sigma, x, v) -> H v, of two slopes that see other random numbers."""

    def product(key, sigma, x, v):
        length = jnp.maximum(jnp.linalg.norm(v), jnp.finfo(v.dtype).tiny)
        gradient = lambda key, x: slope(key, sigma, x)
        shifted = sd.difference_hvp(gradient, SHIFT, shared=False)
        return shifted(key, x, v * (sigma / length)) * (length / sigma)

    return product


def _move(flat: Flat, x, v, g, hv, radius):
    """One step along v, and its length squared."""
    curvature, length = jnp.vdot(v, hv), jnp.linalg.norm(v)
    step = -jnp.vdot(g, v) / jnp.where(curvature > 0, curvature, 1)
    far = radius / jnp.maximum(length, jnp.finfo(v.dtype).tiny)
    step = jnp.clip(step, -far, far)
    return flat.clip(x + step * v), (step * length) ** 2


@jax.jit
def _turn(r, v, new, restart):
    """The next direction, conjugate or the residual itself, and whether it is that."""
    before = jnp.vdot(r, r)
    beta = jnp.where(before > 0, jnp.vdot(new, new) / jnp.where(before > 0, before, 1), 0)
    v = new + beta * v
    again = restart | (jnp.vdot(new, v) <= 0)
    return jnp.where(again, new, v), again


fischer_fr22 = partial(first_order, slope="fischer")
wang_g = partial(first_order, slope="elements")
wang_h = partial(conjugate_gradients, second="hessian")
wang_hvp = partial(conjugate_gradients, second="elements")
wang_hvpa = partial(conjugate_gradients, second="aggregate")

GRID = {"pairs": (1, 2, 4), "trust": (1.0, 2.0, 4.0), "line_search": (1, 2, 4)}
METHODS = {
    "fischer_fr22": MethodEntry(
        "Gradients, constant rate (Fischer-FR22)", (), fischer_fr22, {"rate": (0.1, 0.2, 0.4)}
    ),
    "wang_g": MethodEntry("Importance-sampled gradient, Adam (Wang-G)", ("scene",), wang_g),
    "wang_h": MethodEntry("Conjugate gradients, Hessians (Wang-H)", (), wang_h, GRID),
    "wang_hvp": MethodEntry("Conjugate gradients, products (Wang-HVP)", (), wang_hvp, GRID),
    "wang_hvpa": MethodEntry(
        "Conjugate gradients, aggregate (Wang-HVPA)",
        ("scene", "large", "function"),
        wang_hvpa,
        GRID,
    ),
}
