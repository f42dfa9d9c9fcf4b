"""The public transforms: a function in, its smoothed value or a first derivative of that out."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from smoothdiff._batch import Batch
from smoothdiff._call import Call, transform
from smoothdiff._estimate import combine, displacement, objective
from smoothdiff._importance import Importance, elementwise
from smoothdiff._named_baselines import as_baseline
from smoothdiff._params import Params
from smoothdiff._stderr import (
    free_grad_stderr,
    grad_stderr,
    jacobian_stderr,
    value_stderr,
)


@transform()
def smooth(call: Call) -> Callable:
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
        **options: see `Options`; the signature shows the defaults.

    Returns:
        `g(key, *args)`: the smoothed value, shaped like the output of `fun`; with `has_aux` the
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

    def g(key: Any, *args: Any) -> PyTree:
        if not call.stderr:
            return call.out(*call.smoothed(key, *args))
        params = call.params(key, args)
        batch = call.batch(key, args, params, scalar=False)
        value = combine(batch, *displacement(params))
        return call.out(value, batch.aux, value_stderr(batch, value))

    return g


@transform()
def smooth_value_and_grad(call: Call) -> Callable:
    r"""Value and gradient of the smoothed function from one batch, like `jax.value_and_grad`.

    See [`smooth_grad`][smoothdiff.smooth_grad] for the equation.

    Args:
        fun: a function with a scalar output.
        sigma: as for `smooth`.
        **options: see `Options`.

    Returns:
        `g(key, *args)`: `(value, grad)`; with `has_aux` `((value, aux), grad)`; with `stderr=True`
        the pair of that and `(value_stderr, grad_stderr)`.

    Raises:
        ValueError, TypeError: as `smooth`, and if the output of `fun` is no scalar.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> g = sd.smooth_value_and_grad(jnp.abs, 0.1, num_samples=4096)
        >>> value, grad = g(jax.random.key(0), 2.0)
        >>> print(f"{value:.1f} {grad:.1f}")
        2.0 1.0

    Source: Stochastic Gradient Estimation for Higher-order Differentiable Rendering, eq. 17.
    """

    def g(key: Any, *args: Any) -> PyTree:
        params = call.params(key, args)  # bad arguments are reported before AD hides their values
        if call.stderr:
            value, aux, grad, error = _first_order(call, key, args, params)
            pair = (value, aux) if call.has_aux else value
            return (pair, grad), error
        fun = jax.value_and_grad(
            partial(call.smoothed, scalar=True), call.shifted_argnums(len(args)), has_aux=True
        )
        (value, aux), grad = fun(key, *args)
        return ((value, aux) if call.has_aux else value), grad

    return g


@transform()
def smooth_grad(call: Call) -> Callable:
    r"""The gradient of the smoothed function, like `jax.grad`.

    $$ \nabla F(\theta) = \frac1\sigma \mathbb{E}[f(\theta + \sigma z) \, z]
       \approx \frac{1}{N} \sum_i w_i (f_i - b_i) \, \frac{z_i}{\sigma} $$

    Args:
        fun: a function with a scalar output.
        sigma: as for `smooth`.
        **options: see `Options`.

    Returns:
        `g(key, *args)`: the gradient, like the parameters; with `has_aux` `(grad, aux)`; with
        `stderr=True` the pair of that and the standard errors of the gradient.

    Raises:
        ValueError, TypeError: as `smooth`, and if the output of `fun` is no scalar.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> plateau = lambda x: jnp.floor(jnp.sum(x))
        >>> g, err = sd.smooth_grad(plateau, 0.5, stderr=True)(jax.random.key(0), jnp.ones(2))
        >>> g.shape, err.shape
        ((2,), (2,))

    Source: Stochastic Gradient Estimation for Higher-order Differentiable Rendering, eq. 17.
    """
    if isinstance(call.sampler, Importance):
        return elementwise(call, call.sampler, order=1)
    both = smooth_value_and_grad(call.fun, call.sigma, **call.options())

    def g(key: Any, *args: Any) -> PyTree:
        out = both(key, *args)
        (value, grad), error = out if call.stderr else (out, (None, None))
        return call.out(grad, value[1] if call.has_aux else None, error[1])

    return g


def _first_order(call: Call, key: Any, args: tuple, params: Params) -> tuple:
    """(value, aux, grad, (value_stderr, grad_stderr)) from one batch."""
    copies = None
    if params.free:
        if call.batch_size is not None:
            call.only_smoothed(params, "stderr with batch_size")
        # a copy for each sample, so that one reverse pass gives the derivative of each
        rows = call.num_samples - as_baseline(call.baseline).evaluations()
        copies = [jnp.broadcast_to(leaf, (rows, *leaf.shape)) for leaf in params.free]

    def value_of(free_rows: list | None) -> tuple[Array, tuple[Batch, Array]]:
        batch = call.batch(key, args, params, scalar=True, free_rows=free_rows)
        return (value := objective(batch, jnp.zeros_like(params.theta))), (batch, value)

    free_grads, (batch, value) = jax.grad(value_of, has_aux=True)(copies)
    grad = jax.grad(lambda shift: objective(batch, shift))(jnp.zeros_like(params.theta))
    error = grad_stderr(batch, grad)
    means, errors = [], []
    for per_row in free_grads or []:
        mean, spread = free_grad_stderr(batch, per_row)
        means.append(mean)
        errors.append(spread)
    tree = params.layout.tree
    estimate = tree(grad / params.sigma, means)
    return (
        value,
        batch.aux,
        estimate,
        (value_stderr(batch, value), tree(error / params.sigma, errors)),
    )


@transform()
def smooth_jacobian(call: Call) -> Callable:
    r"""The Jacobian of the smoothed function, like `jax.jacfwd` and `jax.jacrev`.

    $$ \frac{\partial F_p}{\partial \theta_j}
       \approx \frac{1}{N} \sum_i w_i (f_{ip} - b_{ip}) \, \frac{z_{ij}}{\sigma_j} $$

    Args:
        fun: a function whose output is an array or a pytree of arrays, an image for example.
        sigma: as for `smooth`.
        **options: see `Options`.

    Returns:
        `g(key, *args)`: for each leaf of the output the structure of the parameters, with leaves
        of shape output shape + parameter shape; with `has_aux` and `stderr=True` as `smooth`.

    Raises:
        ValueError, TypeError: as `smooth`; `stderr=True` with a sigma of None.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> image = lambda x: jnp.where(jnp.arange(4.0) < x, 1.0, 0.0)
        >>> sd.smooth_jacobian(image, 1.0)(jax.random.key(0), jnp.float32(2.0)).shape
        (4,)

    Source: Stochastic Gradient Estimation for Higher-order Differentiable Rendering, eq. 17.
    """

    def g(key: Any, *args: Any) -> PyTree:
        params = call.params(key, args)
        if not call.stderr:
            outputs = jax.eval_shape(lambda: call.smoothed(key, *args)[0])
            size = sum(leaf.size for leaf in jax.tree.leaves(outputs))
            # forward mode has one pass per parameter, reverse mode one per output
            jacobian = jax.jacfwd if params.theta.size <= size else jax.jacrev
            fun = jacobian(call.smoothed, call.shifted_argnums(len(args)), has_aux=True)
            return call.out(*fun(key, *args))
        call.only_smoothed(params, "stderr of a Jacobian")
        batch = call.batch(key, args, params, scalar=False)
        jacobian = jax.jacfwd(lambda shift: combine(batch, shift))(jnp.zeros_like(params.theta))
        error = jacobian_stderr(batch, jacobian)

        def per_parameter(leaf: Array) -> PyTree:
            sigma = jnp.broadcast_to(params.sigma, leaf.shape)
            tree = params.layout.tree(leaf.astype(sigma.dtype) / sigma)
            return jax.tree.map(lambda j: j.astype(leaf.dtype), tree)

        estimate = jax.tree.map(per_parameter, jacobian)
        error = jax.tree.map(per_parameter, error)
        return call.out(estimate, batch.aux, error)

    return g
