r"""The quadratic that interpolates evaluations, and whose Hessian differs least from the last one.

$$ \min_{g, H} \|H - H_0\|_F, \qquad g \cdot a_i + \tfrac12 a_i \cdot H a_i = f_i - f $$

So 2 n + 1 evaluations are enough to begin with; (n + 1)(n + 2) / 2 determine a quadratic.

A function that is no quadratic has points that contradict each other: interpolated, those along a
line give a Hessian that is far too large. So with a number between these two the points need not be
met exactly: there is a remainder that grows with the distance. With as many as determine a
quadratic, or with those to both sides of the center alone, it is taken where the evidence says so.
Read as the mean of a Gaussian process, whose Hessian varies around the last one, a model has one:

$$ -\tfrac12 (m - n - 1) \log r \cdot w - \tfrac12 \log |\det S| $$

for m points, whose values less the last Hessian's are r; S is the system of equations, and w are
the weights of the points that solve it.

Source: Powell 2004 (NEWUOA, BOBYQA); Rasmussen and Williams 2006, section 2.7, for the evidence;
the errors of points that are high and of those that are far are our own.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from smoothdiff._products import dot
from smoothdiff._solvers._history import History
from smoothdiff._solvers._metric import Metric

# the most evaluations that are interpolated
_MOST = 256
# how far they may be, in radii of the region or of the nearest 2 n + 1 of them
_FARTHEST = 3.0
# evaluations higher than so many times the median are interpolated less and less exactly
_HIGH, _HIGHEST = 3.0, 1e6
# the errors of the others, against the squared distances
_RIDGE = {"float32": 1e-7, "float64": 1e-12}
# what is left of a function that is no quadratic grows as the third power of the distance: this is
# its variance, against that of the Hessian's entries, where the kernel is about 1
_REMAINDER = 3e-3
# the logarithm of the evidence from which on a function is no quadratic
_CLEARLY = 2.0


class Quadratic(NamedTuple):
    """The gradient and the Hessian at the center, in units of the metric.

    So many points are `used`, and one of them has the value that is `highest` above the center's.
    It is `determined` by them, or they are as many as a model takes. `away` are their places, seen
    from the center; those of other points are zero. The farthest is at the distance `farthest`. The
    `polynomial`, a constant, a slope and a bend, is 1 there and 0
    at the others, as far as they are interpolated.
    """

    grad: Float[Array, " n"]
    hessian: Float[Array, "n n"]
    polynomial: tuple[Float[Array, ""], Float[Array, " n"], Float[Array, "n n"]]
    farthest: Float[Array, ""]
    used: Float[Array, ""]
    determined: Bool[Array, ""]
    highest: Float[Array, ""]
    away: Float[Array, "m n"]


def least_change(
    history: History,
    center: Float[Array, " n"],
    fun: Float[Array, ""],
    metric: Metric,
    radius: Float[Array, ""],
    before: Float[Array, "n n"],
) -> Quadratic:
    """The quadratic around the center, where the function has that value.

    Args:
        history: what was evaluated.
        center: the point around which it is, one that was evaluated.
        fun: the value there.
        metric: the coordinates, in which the points nearest to the center are chosen.
        radius: where the quadratic is to hold, in these coordinates.
        before: the Hessian that changes least, in these coordinates.
    """
    n, dtype = len(center), fun.dtype
    tiny = jnp.finfo(dtype).tiny
    away = metric.into(history.points - center[None])
    length = jnp.linalg.norm(away, axis=1)
    # steps below rounding come back to the center, which once is enough of
    again = history.valid & (length == 0) & (history.funs == fun)
    again &= jnp.arange(len(away)) != jnp.argmax(again)
    everywhere = jnp.where(history.valid & ~again, length, jnp.inf)
    # as many as determine a quadratic, as far as a model takes them
    enough = min((n + 1) * (n + 2) // 2, _MOST, len(away))
    nearest, near = jax.lax.top_k(-jnp.asarray(everywhere), enough)
    distance = -jnp.asarray(nearest)
    close = distance[: 2 * n + 1]
    spread = jnp.max(jnp.where(jnp.isfinite(close), close, 0))
    reach = jnp.maximum(radius, spread)
    used = distance <= _FARTHEST * reach
    # so that the kernel is about 1, beside which the errors are small
    width = jnp.minimum(reach, jnp.max(jnp.where(used, distance, 0))) + tiny
    a = jnp.where(used[:, None], away[near], 0) / width
    rise = jnp.where(used, history.funs[near] - fun, 0)
    squares = jnp.sum(a * a, axis=1)
    typical = jnp.nanmedian(jnp.where(used, jnp.abs(rise), jnp.nan))
    high, highest = _HIGH * typical + tiny, jnp.max(rise)
    above = jnp.clip(rise / high, 1, _HIGHEST)
    # what is far beside most of them may be as high as a parabola through them
    bend = jnp.nanmedian(jnp.where(squares > 0, jnp.abs(rise) / (squares + tiny), jnp.nan))
    rise = jnp.minimum(rise, jnp.fmax(_HIGHEST * high, _HIGH * bend * squares))

    old = before * width**2
    borders = jnp.concatenate([used[:, None].astype(dtype), a], axis=1)
    corner = -jnp.finfo(dtype).eps * jnp.eye(n + 1, dtype=dtype)
    bends, sixth = dot(a, a.T) ** 2 / 2, squares**3
    farthest = jnp.argmax(jnp.where(used, distance, -1))
    left = rise - jnp.sum(dot(a, old) * a, axis=1) / 2
    sides = jnp.stack([jnp.where(used, left, 0), jnp.eye(len(a), dtype=dtype)[farthest]])
    sides = jnp.pad(sides, ((0, 0), (0, n + 1)))
    count = jnp.sum(used)
    unit = jnp.max(jnp.abs(sides[0])) + tiny

    def solution(remainder: Array) -> tuple[Array, Array]:
        """Weights of the points, constants and slopes, and the evidence for such a remainder."""
        error = jnp.where(used, (_RIDGE[dtype.name] + remainder * sixth) * above**2, 1)
        system = jnp.block([[bends + jnp.diag(error), borders], [borders.T, corner]])
        factor = jax.scipy.linalg.lu_factor(system)
        solved = jax.scipy.linalg.lu_solve(factor, sides.T)
        # once more for what rounding left, which is much in float32
        solved += jax.scipy.linalg.lu_solve(factor, sides.T - dot(system, solved))
        changes = jnp.maximum(dot(sides[0] / unit, solved[:, 0] / unit), tiny)
        free = jnp.maximum(count - (n + 1), 1).astype(dtype)
        volume = jnp.sum(jnp.log(jnp.abs(jnp.diagonal(factor[0]))))
        finite = jnp.all(jnp.isfinite(solved))
        evidence = -(free * jnp.log(changes) + volume) / 2
        return jnp.where(finite, solved.T, 0), jnp.where(finite, evidence, -jnp.inf)

    solutions, evidence = jax.vmap(solution)(jnp.asarray([0, _REMAINDER], dtype))
    between = (count > 2 * n + 1) & (count < enough)
    inexact = between | (evidence[1] > evidence[0] + _CLEARLY)
    solved = solutions[inexact.astype(jnp.int32)]
    bent = [dot(a.T * weights[None], a) for weights in solved[:, : len(a)]]
    constants, slopes = solved[:, len(a)], solved[:, len(a) + 1 :] / width
    return Quadratic(
        grad=slopes[0],
        hessian=(old + bent[0]) / width**2,
        polynomial=(constants[1], slopes[1], bent[1] / width**2),
        farthest=distance[farthest],
        used=count,
        determined=count >= enough,
        highest=highest,
        away=jnp.where(used[:, None], away[near], 0),
    )
