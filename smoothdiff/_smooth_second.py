"""The public transforms of second order: Hessian, its products, and the quadratic model."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, NamedSharding
from jaxtyping import Array, PyTree

from smoothdiff._baselines import AbstractBaseline
from smoothdiff._call import Call, compiled_once
from smoothdiff._estimate import displacement, objective
from smoothdiff._noise import Noise
from smoothdiff._params import choose, replace
from smoothdiff._quadratic import HessianOperator, QuadraticModel
from smoothdiff._samplers import AbstractSampler


def smooth_hessian(
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
    r"""The Hessian of the smoothed function, like `jax.hessian`.

    $$ \nabla^2 F(\theta)
       \approx \frac{1}{N} \sum_i w_i (f_i - b_i) \, \frac{z_i z_i^T - I}{\sigma^2} $$

    Args:
        fun: a function with a scalar output.
        sigma: as for `smooth`.
        argnums, ..., stderr: see `Options`.

    Returns:
        `g(key, *args)`: the Hessian in the nested structure of `jax.hessian`; with `has_aux` and
        `stderr=True` as `smooth`.

    Raises:
        ValueError, TypeError: as `smooth`; an output that is no scalar; `stderr=True` with a sigma
            of None.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> f = lambda x: jnp.sum(jnp.round(x)) ** 2
        >>> sd.smooth_hessian(f, 0.5)(jax.random.key(0), jnp.ones(2)).shape
        (2, 2)

    Source: Stochastic Gradient Estimation for Higher-order Differentiable Rendering, eq. 20.
    """
    call = Call(**locals())

    def g(key: Any, *args: Any) -> PyTree:
        params = call.params(key, args)
        params.check_free()
        if not call.stderr:
            fun = partial(call.smoothed, scalar=True)
            hessian = jax.hessian(fun, call.shifted_argnums(len(args)), has_aux=True)
            return call.out(*hessian(key, *args))
        call.only_smoothed(params, "stderr of a Hessian")
        batch = call.batch(key, args, params, scalar=True)
        operator = HessianOperator(batch, params.sigma, params.layout)

        def column(j: Array) -> tuple[PyTree, PyTree]:
            unit = params.layout.tree(
                (jnp.arange(params.theta.size) == j).astype(params.theta.dtype)
            )
            return operator.mv(unit), operator.stderr(unit)

        columns = jax.lax.map(column, jnp.arange(params.theta.size))
        # the Hessian is symmetric: what lax.map stacked in front becomes the last axes
        estimate, error = (
            jax.tree.map(lambda c: params.layout.alike(jnp.moveaxis(c, 0, -1)), tree)
            for tree in columns
        )
        return call.out(estimate, batch.aux, error)

    return g


def smooth_hvp(
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
    r"""The product of the smoothed function's Hessian with a vector, without the Hessian.

    $$ \nabla^2 F(\theta) \, v
       \approx \frac{1}{N} \sum_i w_i (f_i - b_i) \, \frac{z_i (z_i \cdot v) - v}{\sigma^2} $$

    The paper differences two smoothed gradients instead (eq. 23, printed with the wrong sign);
    this is its limit, from the same evaluations.

    Args:
        fun: a function with a scalar output.
        sigma: as for `smooth`.
        argnums, ..., stderr: see `Options`; `argnums` counts the arguments of `fun`.

    Returns:
        `g(key, x, v, *other_args)` with `x, *other_args` the arguments of `fun` and `v` a vector
        with the structure of the arguments that `argnums` names: the product, like `v`; with
        `has_aux` and `stderr=True` as `smooth`. With a `batch_size` it is compiled once, as by
        `jax.jit`: what may change from call to call is an argument of `fun`. Of what `fun` only
        refers to, it keeps the values of the first call.

    Raises:
        ValueError, TypeError: as `smooth`; an output that is no scalar; a `v` of another structure
            or shape; `stderr=True` with a sigma of None.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> f = lambda x: jnp.sum(jnp.round(x)) ** 2
        >>> x = jnp.ones(2)
        >>> sd.smooth_hvp(f, 0.5)(jax.random.key(0), x, x).shape
        (2,)

    Source: Stochastic Gradient Estimation for Higher-order Differentiable Rendering, eq. 22.
    """
    call = Call(**locals())

    def product(key: Any, x: PyTree, v: PyTree, *other_args: Any) -> PyTree:
        args = (x, *other_args)
        params = call.params(key, args)
        params.check_free()
        params.layout.check_vector(v)
        if not call.stderr:

            def gradient(target: PyTree) -> tuple[PyTree, PyTree]:
                fun = partial(call.smoothed, scalar=True)
                grad = jax.grad(fun, call.shifted_argnums(len(args)), has_aux=True)
                return grad(key, *replace(args, call.argnums, target))

            _, tangent, aux = jax.jvp(gradient, (choose(args, call.argnums),), (v,), has_aux=True)
            return call.out(tangent, aux)
        call.only_smoothed(params, "stderr of a Hessian-vector product")
        batch = call.batch(key, args, params, scalar=True)
        operator = HessianOperator(batch, params.sigma, params.layout)
        return call.out(operator.mv(v), batch.aux, operator.stderr(v))

    if call.batch_size is None:
        return product
    compiled = compiled_once(product)

    def g(key: Any, x: PyTree, v: PyTree, *other_args: Any) -> PyTree:
        args = (x, *other_args)
        call.params(key, args).layout.check_vector(v)
        target, v = jax.tree.map(jnp.asarray, (choose(args, call.argnums), v))
        x, *others = replace(args, call.argnums, target)
        return compiled(key, x, v, *others)

    return g


def smooth_quadratic(
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
    r"""Value, gradient and Hessian operator of the smoothed function from one batch.

    $$ F(\theta + p) \approx F(\theta) + \nabla F \cdot p + \tfrac12 p \cdot \nabla^2 F \, p $$

    Args:
        fun: a function with a scalar output.
        sigma: as for `smooth`, but a positive width for every leaf.
        argnums, ..., stderr: see `Options`.

    Returns:
        `g(key, x, *other_args)`: a `QuadraticModel`; with `has_aux` the pair of it and aux.
        Products with its Hessian evaluate the function no more. Its value and gradient can be
        differentiated; to AD its Hessian and its standard errors do not depend on x and sigma.

    Raises:
        ValueError, TypeError: as `smooth`; an output that is no scalar; a sigma of None.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> f = lambda x: jnp.sum(jnp.round(x)) ** 2
        >>> model = sd.smooth_quadratic(f, 0.5)(jax.random.key(0), jnp.ones(2))
        >>> model.hessian.mv(model.grad).shape
        (2,)

    Source: Stochastic Gradient Estimation for Higher-order Differentiable Rendering, eq. 17-22.
    """
    call = Call(**locals())
    if call.stderr:
        raise ValueError("smooth_quadratic needs no stderr=True: use model.stderr, hessian_stderr")

    def g(key: Any, *args: Any) -> PyTree:
        params = call.params(key, args)
        call.only_smoothed(params, "a quadratic model")
        batch = call.batch(key, args, params, scalar=True)
        aux, batch = batch.aux, batch.without_aux()
        shift, ratio = displacement(params)
        value, grad = jax.value_and_grad(lambda shift: objective(batch, shift, ratio))(shift)
        sigma = jax.lax.stop_gradient(params.sigma)
        model = QuadraticModel(
            value,
            params.layout.tree(grad / params.sigma),
            HessianOperator(batch, sigma, params.layout),
        )
        return call.out(model, aux)

    return g
