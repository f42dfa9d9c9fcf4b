"""BFGS of other libraries, in units of sigma: on differences, and on a smoothed loss.

Both see the loss in units of its first slope, and what they look at shrinks when BFGS has converged
with it: a wide one sees over plateaus, a narrow one sees the minimum sharply.
"""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx

import smoothdiff as sd
from benchmarks._task import MethodEntry, Problem, Solve
from benchmarks.methods._flat import Flat, package

# optimistix
WIDEST, NARROWEST, SHRINK = 2.0, 1e-4, 0.2  # widths of the differences, in units of sigma
TOLERANCE = 0.01  # of a step of BFGS, in units of the width
MOST = 300  # steps of BFGS with one width
TAGS = frozenset()
# jaxopt
NUM_SAMPLES = 16
SIGMA_SHRINK, SIGMA_END = 0.5, 0.01  # of sigma from round to round, and the last, of the problem's
STEPS = 10  # in a round
SLOPE_END = 1e-3  # of the gradient, as a share of the first one of the round


def on_differences(problem: Problem) -> Solve:
    """BFGS as in optimistix, on central differences: 2 n evaluations for a gradient.

    The width of the differences shrinks (implicit filtering). The first step of each width is one
    sigma long.
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

    @jax.jit
    def slope(u, width):
        size = jnp.linalg.norm(differences(u, width))
        return jnp.where(size > 0, size, 1)

    @eqx.filter_jit
    def init(u, args):
        number = jax.ShapeDtypeStruct((), flat.dtype)
        return solver(args[0]).init(fun, u, args, {}, number, None, TAGS)

    @eqx.filter_jit
    def step(u, args, state):
        u, state, _ = solver(args[0]).step(fun, u, args, {}, state, TAGS)
        return u, state, solver(args[0]).terminate(fun, u, args, {}, state, TAGS)[0]

    def solve(y0, key, record):
        u = jnp.asarray(flat.start(y0) / sigma, flat.dtype)
        for shrink in itertools.accumulate(itertools.repeat(SHRINK), lambda a, b: a * b):
            width = jnp.asarray(max(WIDEST * shrink / SHRINK, NARROWEST), flat.dtype)
            args = width, slope(u, width)
            state = init(u, args)
            for _ in range(MOST):
                u, state, done = step(u, args, state)
                record(flat.tree(sigma * u))
                if done:
                    break
            if width <= NARROWEST:
                return

    return solve


def on_a_smoothed_loss(problem: Problem) -> Solve:
    """L-BFGS as in jaxopt, on a smoothed loss that a fixed key makes deterministic.

    Each round of L-BFGS has samples of its own and a sigma smaller than the last.
    """
    jaxopt = package("jaxopt", "jaxopt")
    flat = Flat(problem)

    def fun(u, key, sigma, unit):
        smoothed = sd.smooth(
            lambda u: flat.loss(problem.sigma * u),
            sigma,
            num_samples=NUM_SAMPLES,
            sampler=sd.Gaussian(antithetic=True),
            baseline="mean",
        )
        return smoothed(key, u) / unit

    solver = jaxopt.LBFGS(fun, linesearch="zoom", maxls=10)
    init = jax.jit(solver.init_state)
    step = jax.jit(solver.update)
    slope = jax.jit(lambda *args: jnp.linalg.norm(jax.grad(fun)(*args, jnp.ones((), flat.dtype))))

    def solve(y0, key, record):
        u = jnp.asarray(flat.start(y0) / problem.sigma, flat.dtype)
        for i in itertools.count():
            sigma = jnp.asarray(max(SIGMA_SHRINK**i, SIGMA_END), flat.dtype)
            args = jax.random.fold_in(key, i), sigma
            unit = slope(u, *args)
            args += (jnp.where(unit > 0, unit, 1),)
            state = init(u, *args)
            for _ in range(STEPS):
                u, state = step(u, state, *args)
                u = flat.clip(problem.sigma * u) / problem.sigma
                record(flat.tree(problem.sigma * u))
                if state.error <= SLOPE_END:
                    break

    return solve


METHODS = {
    "optimistix_bfgs": MethodEntry(
        "BFGS on finite differences (optimistix)", ("scene",), on_differences
    ),
    "jaxopt_lbfgs": MethodEntry(
        "L-BFGS on a smoothed loss, fixed key (jaxopt)", ("scene",), on_a_smoothed_loss
    ),
}
