"""The public transforms of first order: gradient, with or without the value, and Jacobian."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, NamedSharding
from jaxtyping import Array, PyTree

from smoothdiff._baselines import AbstractBaseline
from smoothdiff._batch import Batch
from smoothdiff._call import Call
from smoothdiff._estimate import combine, objective
from smoothdiff._named_baselines import as_baseline
from smoothdiff._noise import Noise
from smoothdiff._params import Params
from smoothdiff._samplers import AbstractSampler
from smoothdiff._stderr import (
    free_grad_stderr,
    grad_stderr,
    jacobian_stderr,
    value_stderr,
)


def smooth_value_and_grad(
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
    r"""Value and gradient of the smoothed function from one batch, like `jax.value_and_grad`.

    See [`smooth_grad`][smoothdiff.smooth_grad] for the equation.

    Args:
        fun: a function with a scalar output.
        sigma: as for `smooth`.
        argnums, ..., stderr: see `Options`.

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
    return _value_and_grad(Call(**locals()))


def smooth_grad(
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
    r"""The gradient of the smoothed function, like `jax.grad`.

    $$ \nabla F(\theta) = \frac1\sigma \mathbb{E}[f(\theta + \sigma z) \, z]
       \approx \frac{1}{N} \sum_i w_i (f_i - b_i) \, \frac{z_i}{\sigma} $$

    Args:
        fun: a function with a scalar output.
        sigma: as for `smooth`.
        argnums, ..., stderr: see `Options`.

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
    call = Call(**locals())
    both = _value_and_grad(call)

    def g(key: Any, *args: Any) -> PyTree:
        out = both(key, *args)
        (value, grad), error = out if call.stderr else (out, (None, None))
        return call.out(grad, value[1] if call.has_aux else None, error[1])

    return g


def _value_and_grad(call: Call) -> Callable[..., Any]:
    def g(key: Any, *args: Any) -> PyTree:
        params = call.params(key, args)  # bad arguments are reported before AD hides their values
        params.check_free()
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


def smooth_jacobian(
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
    r"""The Jacobian of the smoothed function, like `jax.jacfwd` and `jax.jacrev`.

    $$ \frac{\partial F_p}{\partial \theta_j}
       \approx \frac{1}{N} \sum_i w_i (f_{ip} - b_{ip}) \, \frac{z_{ij}}{\sigma_j} $$

    Args:
        fun: a function whose output is an array or a pytree of arrays, an image for example.
        sigma: as for `smooth`.
        argnums, ..., stderr: see `Options`.

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
    call = Call(**locals())

    def g(key: Any, *args: Any) -> PyTree:
        params = call.params(key, args)
        params.check_free()
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
            return params.layout.alike((leaf.astype(sigma.dtype) / sigma).astype(leaf.dtype))

        estimate = jax.tree.map(per_parameter, jacobian)
        error = jax.tree.map(per_parameter, error)
        return call.out(estimate, batch.aux, error)

    return g
