r"""Gauss-Newton where a residual depends on few parameters: which ones, the samples say.

With $r(y + \sigma u) \approx m + J u$ and $u \sim N(0, I)$, the covariance of a parameter with a
residual is their entry of J, and of M samples an entry that is zero seems as large as
$\sqrt{2 \log(n P) / M}$ standard deviations of the residual at most. What is larger is kept, all
else is zero. So M grows with the logarithm of the number of parameters, where without any such
structure a step of M samples is lost in a space of n dimensions. The steps are those of Levenberg
and Marquardt,

$$ u_\lambda = -J^T (J J^T + \lambda I)^{-1} m, $$

for several $\lambda$ at once from one bidiagonalisation of J (Golub and Kahan, 1965). Who asks for
them evaluates all and takes the best.

Source: own; thresholds of correlations are used as localisation in ensemble Kalman filters (Luo
and Bhakta, 2020).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from smoothdiff._products import dot
from smoothdiff._solvers._residual_batch import centred

# the damping of each step, in units of the largest squared singular value
_DAMPINGS = tuple(10.0**-k for k in range(8))
# lengths of the regression's step that are tried beside, and where it is alone
_LENGTHS = (0.5, 1.0, 2.0, 4.0)
_ALONE = tuple(2.0**k for k in range(-4, len(_DAMPINGS)))
# how many steps there are to try
TRIED = len(_ALONE)
# entries of a Jacobian that is written down
_LARGEST = 2 * 10**8
# after the strongest entries are taken off, weaker ones show
_ROUNDS = 2
# iterations of the bidiagonalisation
_KRYLOV = 32


def steps_to_try(
    move: Float[Array, " n"],
    u: Float[Array, "M n"],
    residuals: Float[Array, "M P"],
    valid: Bool[Array, " M"],
    here: Float[Array, " P"],
    count: int,
    low: Float[Array, " n"] | None,
    high: Float[Array, " n"] | None,
) -> Float[Array, "tried n"]:
    """A step at several lengths, and the local ones; the samples are batches of `count` rows."""
    along = lambda lengths: jnp.asarray(lengths, move.dtype)[:, None] * move[None]
    if u.shape[1] * residuals.shape[1] > _LARGEST:
        return along(_ALONE)
    batches = len(u) // count
    split = lambda a: a[len(a) - batches * count :].reshape(batches, count, *a.shape[1:])
    local = local_steps(split(u), split(residuals), split(valid), here, low, high)
    return jnp.concatenate([along(_LENGTHS), local])


def local_steps(
    points: Float[Array, "B M n"],
    residuals: Float[Array, "B M P"],
    valid: Bool[Array, "B M"],
    here: Float[Array, " P"],
    low: Float[Array, " n"] | None,
    high: Float[Array, " n"] | None,
) -> Float[Array, "dampings n"]:
    """Steps from an iterate with the residuals `here`, from the most to the least damped.

    Args:
        points: Batches of samples, each drawn around an iterate of its own, in one unit in which
            the steps are, too. What the iterates did from batch to batch is no sample.
        residuals: There.
        valid: Which of them count.
        here: The residuals at the present iterate.
        low: The lower bounds, seen from the iterate. A parameter that lies at a bound stays there
            if the sum of squares falls outwards.
        high: The upper bounds likewise.
    """
    of_all = lambda x: jax.vmap(centred)(x, valid).reshape(-1, x.shape[-1])
    slopes = _slopes(of_all(points), of_all(residuals), jnp.sum(valid))
    if low is not None and high is not None:
        gradient = dot(slopes, here)
        active = ((low >= 0) & (gradient > 0)) | ((high <= 0) & (gradient < 0))
        slopes = jnp.where(active[:, None], 0, slopes)
    return _damped(slopes, here)


def _slopes(u: Array, r: Array, count: Array) -> Array:
    """What a unit of each parameter does to each residual; zero where it may well be chance."""
    squares = jnp.sum(u**2, axis=0)[:, None]
    squares = jnp.where(squares > 0, squares, 1)
    n, size = u.shape[1], r.shape[1]
    chance = 2 * jnp.log(jnp.asarray(n, r.dtype) * size) / count.astype(r.dtype)
    slopes, left = jnp.zeros((n, size), r.dtype), r
    for _ in range(_ROUNDS):
        more = dot(u.T, left) / squares
        kept = (slopes != 0) | (more**2 * squares > chance * jnp.sum(left**2, axis=0)[None])
        slopes = jnp.where(kept, slopes + more, 0)
        left = r - dot(u, slopes)
    return slopes


def _damped(slopes: Array, here: Array) -> Array:
    """The steps, in the space of the first directions of a bidiagonalisation."""

    def unit(x: Array) -> tuple[Array, Array]:
        length: Array = jnp.linalg.norm(x)
        return x / jnp.where(length > 0, length, 1), length

    left, size = unit(here)
    right, alpha = unit(dot(slopes, left))

    def iterate(carry: tuple, _) -> tuple:
        left, right, alpha = carry
        new_left, beta = unit(dot(right, slopes) - alpha * left)
        new_right, new_alpha = unit(dot(slopes, new_left) - beta * right)
        return (new_left, new_right, new_alpha), (right, alpha, beta)

    _, (right, alpha, beta) = jax.lax.scan(iterate, (left, right, alpha), None, length=_KRYLOV)
    lower = jnp.zeros((_KRYLOV + 1, _KRYLOV), here.dtype)
    along = jnp.arange(_KRYLOV)
    lower = lower.at[along, along].set(alpha).at[along + 1, along].set(beta)
    u, s, vt = jnp.linalg.svd(lower, full_matrices=False)
    damping = s[0] ** 2 * jnp.asarray(_DAMPINGS, here.dtype)[:, None]
    gain = s[None] / jnp.where(s[0] > 0, s[None] ** 2 + damping, 1)
    return -size * dot(dot(gain * u[0][None], vt), right)
