"""BFGS of other libraries, in units of sigma: on differences, and on a smoothed loss.

Both see the loss in units of its first slope, and what they look at shrinks when BFGS has converged
with it: a wide one sees over plateaus, a narrow one sees the minimum sharply.
"""

import itertools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx

import smoothdiff as sd
from benchmarks._task import MethodEntry, Problem, Solve
from benchmarks.methods._flat import Flat, package

# optimistix
WIDTHS = [max(2.0 * 0.2**i, 1e-4) for i in range(8)]  # of the differences, in units of sigma
TOLERANCE = 0.01  # of a step of BFGS, in units of the width
MOST = 300  # steps of BFGS with one width
TAGS = frozenset()
# jaxopt
NUM_SAMPLES = 16
SIGMA_SHRINK, SIGMA_END = 0.5, 0.01  # of sigma from round to round, and the last, of the problem's
STEPS = 10  # in a round
SLOPE_END = 1e-3  # of the gradient, as a share of the first one of the round


def on_differences(problem: Problem, *, widest: float = WIDTHS[0]) -> Solve:
    """BFGS as in optimistix, on central differences: 2 n evaluations for a gradient.

    The width of the differences shrinks (implicit filtering), from the widest, in units of sigma.
    The first step of each width is one sigma long.
    """
    flat, sigma = Flat(problem), problem.sigma
    scaled = lambda u: flat.loss(sigma * u)

    def differences(u, width):
        inside = flat.clip(sigma * u)[None] / sigma
        shifts = width * jnp.eye(flat.size, dtype=flat.dtype)
        points = flat.clip(sigma * (inside + jnp.concatenate([shifts, -shifts]))) / sigma
        ahead, behind = points[: flat.size], points[flat.size :]
        values = jax.vmap(scaled)(points)
        # at a bound the difference is one-sided
        return (values[: flat.size] - values[flat.size :]) / jnp.diag(ahead - behind)

    # optimistix asks for the gradient of accepted steps only, in the backward pass
    loss = jax.custom_vjp(lambda u, width: scaled(u))
    loss.defvjp(
        lambda u, width: (scaled(u), (u, width)),
        lambda kept, slope: (slope * differences(*kept), jnp.zeros_like(kept[1])),
    )

    def fun(u, args):
        width, unit = args
        return loss(u, width) / unit, None

    solver = lambda width: optx.BFGS(rtol=0.0, atol=TOLERANCE * width)
    slope = jax.jit(lambda u, width, key: jnp.linalg.norm(differences(u, width)))

    @eqx.filter_jit
    def init(u, width, key, unit):
        number = jax.ShapeDtypeStruct((), flat.dtype)
        return solver(width).init(fun, u, (width, unit), {}, number, None, TAGS)

    @eqx.filter_jit
    def step(u, state, width, key, unit):
        args = width, unit
        u, state, _ = solver(width).step(fun, u, args, {}, state, TAGS)
        return u, state, solver(width).terminate(fun, u, args, {}, state, TAGS)[0]

    widths = [widest / WIDTHS[0] * width for width in WIDTHS]
    return rounds(flat, lambda: widths, slope, init, step, MOST)


def on_a_smoothed_loss(problem: Problem) -> Solve:
    """L-BFGS as in jaxopt, on a smoothed loss that a fixed key makes deterministic.

    Each round of L-BFGS has samples of its own and a sigma smaller than the last.
    """
    jaxopt = package("jaxopt", "jaxopt")
    flat = Flat(problem)

    def fun(u, sigma, key, unit):
        smoothed = sd.smooth(
            lambda u: flat.loss(problem.sigma * u),
            sigma,
            num_samples=NUM_SAMPLES,
            sampler=sd.Gaussian(antithetic=True),
            baseline="mean",
        )
        return smoothed(key, u) / unit

    solver = jaxopt.LBFGS(fun, linesearch="zoom", maxls=10)
    update = jax.jit(solver.update)
    slope = jax.jit(lambda *args: jnp.linalg.norm(jax.grad(fun)(*args, jnp.ones((), flat.dtype))))

    def step(u, state, *args):
        u, state = update(u, state, *args)
        return flat.clip(problem.sigma * u) / problem.sigma, state, state.error <= SLOPE_END

    sigmas = lambda: (max(SIGMA_SHRINK**i, SIGMA_END) for i in itertools.count())
    return rounds(flat, sigmas, slope, jax.jit(solver.init_state), step, STEPS)


def rounds(
    flat: Flat, widths: Callable, slope: Callable, init: Callable, step: Callable, most: int
) -> Solve:
    """A search with each of `widths()` from where the last one ended, of so many steps at most.

    All take the width, a key of the round, and the size of the first slope, which is the unit.
    """
    sigma = flat.problem.sigma

    def solve(y0, key, record):
        u = jnp.asarray(flat.start(y0) / sigma, flat.dtype)
        for i, width in enumerate(widths()):
            looks = jnp.asarray(width, flat.dtype), jax.random.fold_in(key, i)
            unit = slope(u, *looks)
            args = *looks, jnp.where(unit > 0, unit, 1)
            state = init(u, *args)
            for _ in range(most):
                u, state, done = step(u, state, *args)
                record(flat.tree(sigma * u))
                if done:
                    break

    return solve


METHODS = {
    "optimistix_bfgs": MethodEntry(
        "BFGS on finite differences (optimistix)",
        ("scene",),
        on_differences,
        {"widest": (1.0, 2.0, 4.0)},
    ),
    "jaxopt_lbfgs": MethodEntry(
        "L-BFGS on a smoothed loss, fixed key (jaxopt)", ("scene",), on_a_smoothed_loss
    ),
}
