"""A cheap function in place of an expensive one, and few samples of what is between the two."""

from collections.abc import Callable
from typing import Any, Unpack

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from smoothdiff._call import Options
from smoothdiff._params import as_first_key
from smoothdiff._samplers import Sobol
from smoothdiff._smooth_second import smooth_quadratic

# as many as cost little beside one picture; in replicates, so that fits to them leave one out
_SURROGATE: Options = {"num_samples": 4096, "sampler": Sobol(replicates=8), "baseline": "mean"}


def control_variate(
    transform: Callable[..., Callable],
    fun: Callable,
    surrogate: Callable,
    sigma: PyTree,
    *,
    surrogate_options: Options | None = None,
    **options: Unpack[Options],
) -> Callable:
    r"""A transform of `fun`, with a cheap function that is like it as a control variate.

    $$ T[f] = T[f - h] + T[h] $$

    All transforms T are linear in the function. T[f - h] needs few samples where h is near f. T[h]
    needs many samples, but none of f. Both are unbiased for any h if their sampler and baseline
    are, so a bad surrogate costs accuracy and makes no bias. The baseline is applied to f - h.

    Args:
        transform: `smooth`, `smooth_grad`, `smooth_value_and_grad`, `smooth_jacobian`,
            `smooth_hessian` or `smooth_hvp`.
        fun: the function that is expensive.
        surrogate: h, the cheap function. It takes the same arguments, and its output is like that
            of `fun`: what `ZeroGrads.learnt` returns, a coarser picture, a model of an earlier
            design. It must not depend on the key of this call, nor on samples drawn with it.
        sigma: as for `smooth`.
        surrogate_options: what the second part has in place of 4,096 points in eight scrambled
            sets and the baseline "mean". With `{"baseline": "quadratic"}` it is exact to rounding
            for a quadratic surrogate of up to 60 or so parameters.
        **options: see `Options`; `num_samples` counts the evaluations of `fun`.

    Returns:
        A function that is called like the one that `transform(fun, sigma, **options)` returns.

    Raises:
        ValueError, TypeError: as the transform; `has_aux=True`, which a surrogate cannot give;
            `smooth_quadratic`.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> steps = lambda x: jnp.sum(jnp.round(8 * x**2) / 8)
        >>> smooth = lambda x: jnp.sum(x**2)
        >>> g = sd.control_variate(sd.smooth_grad, steps, smooth, 0.5, num_samples=16)
        >>> [round(float(d), 1) for d in g(jax.random.key(0), jnp.ones(2))]
        [2.0, 2.0]

    Source: own; control variates whose mean is estimated, as in multilevel Monte Carlo (Giles,
    2008). ZeroGrads (Fischer and Ritschel) only descends on its surrogate.
    """
    if transform is smooth_quadratic:
        raise ValueError(
            "two quadratic models have no sum that is one: use smooth_value_and_grad, smooth_hvp "
            "or smooth_hessian"
        )
    if options.get("has_aux", False):
        raise ValueError("a surrogate has no aux: use has_aux=False, or the transform by itself")

    def left(*args: Any) -> PyTree:
        return jax.tree.map(jnp.subtract, fun(*args), surrogate(*args))

    # noise draws its points itself
    usual = _SURROGATE if options.get("noise") is None else {**_SURROGATE, "sampler": None}
    of_surrogate = {**options, **usual, **(surrogate_options or {})}
    parts = transform(left, sigma, **options), transform(surrogate, sigma, **of_surrogate)

    def g(key: Any, *args: Any) -> PyTree:
        first, second = (
            part(k, *args)
            for part, k in zip(parts, jax.random.split(as_first_key(key)), strict=True)
        )
        if not options.get("stderr", False):
            return jax.tree.map(jnp.add, first, second)
        (estimate, error), (known, known_error) = first, second
        total = jax.tree.map(jnp.add, estimate, known)
        return total, jax.tree.map(jnp.hypot, error, known_error)

    return g
