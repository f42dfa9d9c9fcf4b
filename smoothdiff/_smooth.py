"""The public transform of which the others are derivatives: the smoothed value."""

from collections.abc import Callable, Sequence
from typing import Any, Literal

from jax.sharding import Mesh, NamedSharding
from jaxtyping import Array, PyTree

from smoothdiff._baselines import AbstractBaseline
from smoothdiff._call import Call
from smoothdiff._estimate import combine, displacement
from smoothdiff._noise import Noise
from smoothdiff._samplers import AbstractSampler
from smoothdiff._stderr import value_stderr


def smooth(
    fun: Callable[..., Any],
    sigma: PyTree,
    *,
    argnums: int | Sequence[int] = 0,
    num_samples: int = 64,
    sampler: AbstractSampler | None = None,
    noise: Noise | None = None,
    baseline: str | AbstractBaseline = "auto",
    support: Callable[[PyTree], Array] | None = None,
    bounds: tuple[PyTree, PyTree] | None = None,
    batch_size: int | None = None,
    sharding: Mesh | NamedSharding | None = None,
    nonfinite: Literal["propagate", "drop"] = "propagate",
    has_aux: bool = False,
    stderr: bool = False,
) -> Callable[..., Any]:
    r"""The function convolved with a Gaussian, as a function of a key that JAX can differentiate.

    $$ F(\theta) = \mathbb{E}_{z \sim \mathcal{N}(0, I)}[f(\theta + \sigma z)] $$

    Estimated from evaluations of f alone, which may be a black box. `jax.grad`, `jax.hessian`,
    `jax.jvp`, `jax.linearize` and so on of the result, with respect to the smoothed parameters,
    sigma, and (if f can be differentiated there) everything else, are the unbiased estimates that
    the same evaluations give; no derivative of f with respect to smoothed parameters is taken.

    Args:
        fun: the function; returns an array or a pytree of arrays. Under `jax.vmap`.
        sigma: the width of the Gaussian in the units of the parameters: a number, or a pytree
            like the parameters with numbers or arrays that broadcast to them. None in a leaf: not
            smoothed, not sampled, differentiated by AD. It may be traced and differentiated.
        argnums, ..., stderr: see `Options`, which describes them for all transforms.

    Returns:
        `g(key, *args)`: the smoothed value, shaped like the output of `fun`, in float32 at least;
        with `has_aux` the
        pair of it and aux, with `stderr=True` the pair of that and standard errors.

    Raises:
        ValueError, TypeError: an argument that cannot work and can be looked at. Traced arguments
            that turn out invalid give NaN.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> step = lambda x: jnp.where(x > 0, 1.0, 0.0)
        >>> g = sd.smooth(step, 0.5, num_samples=4096)
        >>> print(f"{jax.grad(g, argnums=1)(jax.random.key(0), 0.0):.1f}")  # normal density
        0.8

    Source: Stochastic Gradient Estimation for Higher-order Differentiable Rendering, eq. 13-15.
    """
    call = Call(**locals())

    def g(key: Any, *args: Any) -> PyTree:
        if not call.stderr:
            return call.out(*call.smoothed(key, *args))
        params = call.params(key, args)
        batch = call.batch(key, args, params, scalar=False)
        value = combine(batch, *displacement(params))
        return call.out(value, batch.aux, value_stderr(batch, value))

    return g
