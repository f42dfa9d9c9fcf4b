"""BFGS as in optimistix, on central differences: 2 n evaluations for a gradient.

The width of the differences shrinks when BFGS has converged with it (implicit filtering): a wide
one sees over plateaus, a narrow one sees the minimum sharply. Parameters are in units of sigma and
the loss in units of its first slope, so that the first step of each width is one sigma long.
"""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx

from benchmarks._task import Solve, Task
from benchmarks.methods._flat import Flat

TITLE = "BFGS on finite differences (optimistix)"
WIDEST, NARROWEST, SHRINK = 2.0, 1e-4, 0.2  # widths of the differences, in units of sigma
TOLERANCE = 0.01  # of a step of BFGS, in units of the width
MOST = 300  # steps of BFGS with one width
TAGS = frozenset()


def prepare(task: Task) -> Solve:
    """Compiles a step of BFGS once, for all widths."""
    flat = Flat(task)
    scaled = lambda u: flat.loss(task.sigma * u)

    def differences(u, width):
        inside = flat.clip(task.sigma * u)[None] / task.sigma
        shifts = width * jnp.eye(flat.size, dtype=flat.dtype)
        points = flat.clip(task.sigma * (inside + jnp.concatenate([shifts, -shifts]))) / task.sigma
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
        u = jnp.asarray(flat.start(y0) / task.sigma, flat.dtype)
        for shrink in itertools.accumulate(itertools.repeat(SHRINK), lambda a, b: a * b):
            width = jnp.asarray(max(WIDEST * shrink / SHRINK, NARROWEST), flat.dtype)
            args = width, slope(u, width)
            state = init(u, args)
            for _ in range(MOST):
                u, state, done = step(u, args, state)
                record(flat.tree(task.sigma * u))
                if done:
                    break
            if width <= NARROWEST:
                return

    return solve
