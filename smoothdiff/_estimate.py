r"""The estimate from evaluated points: the only place that knows the weights.

With the points $x_i = \bar\theta + \bar\sigma z_i$ fixed, the weight of point i at other
parameters is the density of the Gaussian there over the density that drew it,

$$ \log w_i = \log \frac{p(z_i)}{q(z_i)} - \tfrac12 |u_i|^2 + \tfrac12 |z_i|^2 + \sum \log\rho,
   \quad u_i = \rho z_i - d, \quad d = \frac{\theta - \bar\theta}{\sigma},
   \quad \rho = \frac{\bar\sigma}{\sigma}. $$

At $d = 0$, $\rho = 1$ this is p/q. Its derivatives there are all that derivatives of the smoothed
function need.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from smoothdiff._batch import Batch
from smoothdiff._noise import NoiseSampler
from smoothdiff._params import Params
from smoothdiff._products import combined, dot
from smoothdiff._support import term_weights


def displacement(params: Params) -> tuple[Array, Array | None]:
    """The pair (d, rho): zeros and ones in value, with the derivatives in theta and sigma.

    rho is None where sigma is a plain number: it cannot be differentiated, and without it the
    weights are a single matrix product.
    """
    theta, sigma = jax.lax.stop_gradient((params.theta, params.sigma))
    shift = (params.theta - theta) / params.sigma
    return shift, sigma / params.sigma if params.sigma_traced else None


def weights(
    batch: Batch,
    z: Float[Array, "m n"],
    log_ratio: Float[Array, " m"] | None,
    shift: Float[Array, " n"] | Float[Array, "m n"],
    ratio: Float[Array, " n"] | None = None,
) -> Float[Array, " m"] | Float[Array, "m ..."]:
    """The weights of the points at the displaced parameters; a row of `shift` for each is allowed.

    With a support there is one for each term as well, made of its own parameters only.
    """
    if isinstance(batch.draws.sampler, NoiseSampler):
        log_w = _log_noise(batch.draws.sampler, z, shift, ratio)
    elif batch.support is not None:
        rows = shift if shift.ndim == 2 else shift[None]
        log_w = z * rows - rows * rows / 2
        if ratio is not None:
            log_w = z * (rows * ratio[None]) - rows * rows / 2
            log_w += z * z * ((1 - ratio**2) / 2)[None] + jnp.log(ratio)[None]
        return term_weights(batch.support, batch.layout.tree, log_w)
    else:
        log_w = _log_gaussian(z, shift, ratio)
    return jnp.exp(log_w if log_ratio is None else log_w + log_ratio)


def _log_gaussian(z: Array, shift: Array, ratio: Array | None) -> Array:
    # Expanded so that z meets the parameters in matrix products only and nothing is divided by
    # sigma^2: with 300 parameters the Hessian is 200 times faster than by differentiating |u|^2.
    scaled = shift if ratio is None else ratio * shift
    if shift.ndim == 2:
        log_w = jnp.sum(z * scaled, axis=1) - jnp.sum(shift * shift, axis=1) / 2
    else:
        log_w = dot(z, scaled) - jnp.sum(shift * shift) / 2
    if ratio is not None:
        log_w += dot(z * z, (1 - ratio**2) / 2)
        log_w += jnp.sum(jnp.log(ratio))
    return log_w


def _log_noise(noise: NoiseSampler, z: Array, shift: Array, ratio: Array | None) -> Array:
    rows = shift if shift.ndim == 2 else shift[None]
    moved = (z if ratio is None else z * ratio[None]) - rows
    log_w = noise.log_prob(moved) - noise.log_prob(z)
    return log_w if ratio is None else log_w + jnp.sum(jnp.log(ratio))


def weigh(w: Array, rows: Array) -> Array:
    """Weights times rows, each weight on the whole row or on its own term."""
    return w.astype(rows.dtype).reshape(*w.shape, *[1] * (rows.ndim - w.ndim)) * rows


@eqx.filter_jit  # a program of its own where the caller does not jit, as in `_draws`, `_batch`
def combine(
    batch: Batch, shift: Float[Array, " n"], ratio: Float[Array, " n"] | None = None
) -> PyTree:
    """The smoothed function at displaced parameters, 1/N sum_i w_i (f_i - b_i) + B."""

    def chunk(start, z, log_ratio, residual):
        w = weights(batch, z, log_ratio, shift, ratio)
        if w.ndim > 1:
            return jax.tree.map(lambda r: jnp.sum(weigh(w, r), axis=0), residual)
        return jax.tree.map(lambda r: combined(w, r), residual)

    total = batch.draws.sum(chunk, batch.control.residual)
    back = batch.control.smoothed(shift, ratio)
    return jax.tree.map(lambda t, b: batch.scale.astype(t.dtype) * t + b, total, back)


def objective(
    batch: Batch, shift: Float[Array, " n"], ratio: Float[Array, " n"] | None = None
) -> Float[Array, ""]:
    """The smoothed scalar: the value itself, or the sum of the terms if there is a support."""
    return jnp.sum(combine(batch, shift, ratio))
