r"""The estimate from evaluated points: the only place that knows the weights.

With the points $x_i = \bar\theta + \bar\sigma z_i$ fixed, the weight of point i at other
parameters is the density of the Gaussian there over the density that drew it,

$$ \log w_i = \log \frac{p(z_i)}{q(z_i)} - \tfrac12 |u_i|^2 + \tfrac12 |z_i|^2 + \sum \log\rho,
   \quad u_i = \rho z_i - d, \quad d = \frac{\theta - \bar\theta}{\sigma},
   \quad \rho = \frac{\bar\sigma}{\sigma}. $$

At $d = 0$, $\rho = 1$ this is p/q. Its derivatives there are all that derivatives of the smoothed
function need.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from smoothdiff._batch import Batch
from smoothdiff._params import Params


def displacement(params: Params) -> tuple[Array, Array | None]:
    """The pair (d, rho): zeros and ones in value, with the derivatives in theta and sigma.

    rho is None where sigma is a plain number: it cannot be differentiated, and without it the
    weights are a single matrix product.
    """
    theta, sigma = jax.lax.stop_gradient((params.theta, params.sigma))
    shift = (params.theta - theta) / params.sigma
    return shift, sigma / params.sigma if params.sigma_traced else None


def weights(
    z: Float[Array, "m n"],
    log_ratio: Float[Array, " m"] | None,
    shift: Float[Array, " n"] | Float[Array, "m n"],
    ratio: Float[Array, " n"] | None = None,
) -> Float[Array, " m"]:
    """The weights of the points at the displaced parameters; a row of `shift` for each is allowed.

    Expanded so that z meets the parameters in matrix products only and nothing is divided by
    sigma^2: with 300 parameters the Hessian is 200 times faster than by differentiating |u|^2.
    """
    scaled = shift if ratio is None else ratio * shift
    if shift.ndim == 2:
        log_w = jnp.sum(z * scaled, axis=1) - jnp.sum(shift * shift, axis=1) / 2
    else:
        log_w = jnp.matmul(z, scaled, precision="highest") - jnp.sum(shift * shift) / 2
    if ratio is not None:
        log_w += jnp.matmul(z * z, (1 - ratio**2) / 2, precision="highest")
        log_w += jnp.sum(jnp.log(ratio))
    return jnp.exp(log_w if log_ratio is None else log_w + log_ratio)


def combine(
    batch: Batch, shift: Float[Array, " n"], ratio: Float[Array, " n"] | None = None
) -> PyTree:
    """The smoothed function at displaced parameters, 1/N sum_i w_i (f_i - b_i) + b."""

    def chunk(start, z, log_ratio, residual):
        w = weights(z, log_ratio, shift, ratio)
        return jax.tree.map(
            lambda r: jnp.tensordot(w.astype(r.dtype), r, axes=1, precision="highest"), residual
        )

    total = batch.draws.sum(chunk, batch.control.residual)
    return jax.tree.map(lambda t, b: batch.scale.astype(t.dtype) * t + b, total, batch.control.mean)
