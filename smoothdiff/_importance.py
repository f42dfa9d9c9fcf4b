r"""The papers' elementwise estimators: a set of samples of its own for each element.

$$ \partial_i F = \frac1N \sum_k \frac{\partial_i \mathcal{N}(x_k)}{q_i(x_k)} f(x_k), \qquad
   q_i \propto |\partial_i \mathcal{N}| $$

The proposal of an element is the best for that element alone, so a gradient takes n sets of
samples and a Hessian n(n+1)/2. They are transforms of their own, no samplers.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, PyTree

from smoothdiff import kernels
from smoothdiff._baselines import AbstractBaseline, Mean
from smoothdiff._call import Call
from smoothdiff._estimate import displacement, objective
from smoothdiff._named_baselines import Auto, as_baseline
from smoothdiff._params import as_first_key
from smoothdiff._samplers import PointSampler


class ElementSampler(PointSampler):
    """Points for one element (i, j): its positivised kernel there, Gaussian elsewhere."""

    gaussian: ClassVar[bool] = False
    element: Int[Array, "2"]
    order: Literal[1, 2] = eqx.field(static=True)
    antithetic: bool = eqx.field(static=True)
    quasi: bool = eqx.field(static=True)
    blur: Literal["all", "own"] = eqx.field(static=True)

    def mirrored(self) -> bool:
        return self.antithetic

    def scrambled_sets(self) -> int:
        return int(self.quasi)

    def points(self, u, n):
        i, j = self.element
        dims = jnp.arange(n)[None]
        own = (dims == i) | (dims == j)
        normal, first = kernels.inverse_cdf(u, 1.0, 0), kernels.inverse_cdf(u, 1.0, 1)
        special = first
        if self.order == 2:
            second = kernels.inverse_cdf(u[:, i], 1.0, 2)[:, None]
            special = jnp.where(i == j, second, first)
        z = jnp.where(own, special, normal if self.blur == "all" else 0)
        density = kernels.log_density
        log_ratio = density(z, 1.0, 0) - density(z, 1.0, 1)
        if self.order == 2:
            log_ratio = jnp.where(i == j, density(z, 1.0, 0) - density(z, 1.0, 2), log_ratio)
        return z, jnp.sum(jnp.where(own, log_ratio, 0), axis=1)


class Importance(eqx.Module):
    """The gradient or the Hessian of the smoothed function, by elementwise importance sampling.

    A transform, called like `smooth_grad` or `smooth_hessian`. `num_samples` is for each element,
    so the evaluations are n times that for a gradient, of order 1, and n(n+1)/2 times for a
    Hessian, of order 2 (its symmetry is used).

    JAX can differentiate the result with respect to all that `smooth` can. Its points are placed
    for the element alone, so these derivatives have more noise than those of `smooth`.

    Args:
        order: 1 for the gradient, 2 for the Hessian.
        antithetic: mirror every point, as in the paper.
        quasi: quasi-random points instead of independent ones.
        blur: "all" smooths over all parameters. "own" smooths each derivative over its own
            parameters only, as FR22 does. Each element is then the derivative of another function,
            and has no derivative with respect to parameters and sigma.

    Raises:
        ValueError: another order or another `blur`; when it is called, what `smooth` refuses.
        TypeError: with `blur="own"` a derivative with respect to parameters or sigma.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> f = lambda x: jnp.floor(jnp.sum(x))
        >>> g = sd.Importance(1)(f, 1.0, num_samples=8)
        >>> g(jax.random.key(0), jnp.zeros(3)).shape  # 24 evaluations
        (3,)

    Source: Stochastic Gradient Estimation for Higher-order Differentiable Rendering, eq. 17-21 and
    appendices A, B, D; "own" is Plateau-reduced Differentiable Path Tracing (FR22).
    """

    order: Literal[1, 2] = eqx.field(static=True)
    antithetic: bool = eqx.field(static=True, default=True)
    quasi: bool = eqx.field(static=True, default=False)
    blur: Literal["all", "own"] = eqx.field(static=True, default="all")

    def __check_init__(self):
        if self.order not in (1, 2):
            raise ValueError(f"order must be 1 (gradients) or 2 (Hessians), not {self.order!r}")
        if self.blur not in ("all", "own"):
            raise ValueError(f'blur must be "all" or "own", not {self.blur!r}')

    def __call__(
        self,
        fun: Callable[..., Any],
        sigma: PyTree,
        *,
        argnums: int | Sequence[int] = 0,
        num_samples: int = 64,
        baseline: str | AbstractBaseline = "auto",
        bounds: tuple[PyTree, PyTree] | None = None,
        batch_size: int | None = None,
        nonfinite: Literal["propagate", "drop"] = "propagate",
    ) -> Callable[..., PyTree]:
        """`g(key, *args)`: the derivative, as `smooth_grad` or `smooth_hessian` returns it.

        Args:
            fun: a function with a scalar output.
            sigma: as for `smooth`, but a positive width for every leaf.
            argnums, ..., nonfinite: see `Options`; `num_samples` is for each element. With
                `blur="own"` the default baseline is "mean".

        Raises:
            ValueError, TypeError: as `smooth`; an output that is no scalar; a sigma of None; with
                `blur="own"` a baseline that is fitted.
        """
        call = Call(
            fun,
            sigma,
            argnums,
            num_samples,
            baseline,
            bounds=bounds,
            batch_size=batch_size,
            nonfinite=nonfinite,
        )
        if self.blur == "own":
            # the points leave the other parameters as they are, which no fit of all of them knows
            given = as_baseline(baseline)
            if not isinstance(given, Auto) and not given.termwise:
                raise ValueError('blur="own" goes with baseline="mean", "center" or "none"')
            call = replace(call, baseline=Mean() if isinstance(given, Auto) else given)
        return partial(self._derivative, call)

    def _derivative(self, call: Call, key: Any, *args: Any) -> PyTree:
        params = call.params(key, args)
        call.only_smoothed(params, "Importance")
        if self.blur == "own":
            params = replace(params, theta=_fixed(params.theta), sigma=_fixed(params.sigma))
        n, layout = params.theta.size, params.layout
        order, sampler = self.order, partial(ElementSampler, **vars(self))
        shift, ratio = displacement(params)

        def element(inputs: tuple[Array, Array]) -> Array:
            pair, k = inputs
            batch = replace(call, sampler=sampler(element=pair)).batch(k, args, params, scalar=True)
            along = lambda i: (jnp.arange(n) == i).astype(shift.dtype)
            value = lambda d: objective(batch, d, ratio)
            first = lambda d: jax.jvp(value, (d,), (along(pair[0]),))[1]
            return first(shift) if order == 1 else jax.jvp(first, (shift,), (along(pair[1]),))[1]

        # the elements that are sampled: parameters twice, or pairs i <= j
        pairs = np.stack([np.arange(n)] * 2 if order == 1 else np.triu_indices(n), axis=1)
        keys = jax.vmap(lambda e: jax.random.fold_in(as_first_key(key), e))(jnp.arange(len(pairs)))
        out = jax.lax.map(element, (jnp.asarray(pairs), keys)).astype(params.theta.dtype)
        if order == 1:
            return layout.tree(out / params.sigma)
        i, j = pairs.T
        out = out / (params.sigma[i] * params.sigma[j])
        matrix = jnp.zeros((n, n), out.dtype).at[i, j].set(out).at[j, i].set(out)
        rows = layout.tree(matrix)
        return jax.tree.map(lambda row: layout.alike(jnp.moveaxis(row, 0, -1)), rows)


@jax.custom_jvp
def _fixed(x: Array) -> Array:
    """What cannot be differentiated, rather than with a derivative of zero."""
    return x


@_fixed.defjvp
def _(primals: tuple, tangents: tuple) -> tuple:
    raise TypeError(
        'with blur="own" each element smooths over its own parameters only, so samples do not say '
        'how it depends on the others: to differentiate it again use blur="all"'
    )


def difference_hvp(
    grad: Callable[..., PyTree], step: float, *, shared: bool = True
) -> Callable[..., PyTree]:
    r"""The papers' Hessian-vector product: the central difference of smoothed gradients.

    $$ H v \approx \frac{\nabla F(\theta + \varepsilon v) - \nabla F(\theta - \varepsilon v)}
       {2 \varepsilon} $$

    For comparison with the papers. `smooth_hvp` is its limit for a small step, from half of the
    evaluations. Here the gradient is estimated at both points, with common random numbers or, as in
    the paper's code, with independent ones. The paper prints the opposite sign.

    Args:
        grad: `g(key, x, *args)`, a gradient such as `smooth_grad` makes.
        step: ε, in units of v.
        shared: whether both gradients see the same random numbers.

    Returns:
        `g(key, x, v, *args)`: the product, like `x`; it makes twice the evaluations of `grad`.

    Raises:
        ValueError: a step that is not positive.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> grad = sd.smooth_grad(lambda x: jnp.sum(x**2), 0.1, num_samples=1024)
        >>> hvp = sd.difference_hvp(grad, 0.1)
        >>> print(hvp(jax.random.key(0), jnp.zeros(1), jnp.ones(1)).round())
        [2.]

    Source: Stochastic Gradient Estimation for Higher-order Differentiable Rendering, eq. 8 and 23.
    """
    if not step > 0:
        raise ValueError(f"step must be positive, not {step}")

    def g(key: Any, x: PyTree, v: PyTree, *args: Any) -> PyTree:
        keys = (key, key) if shared else tuple(jax.random.split(key))

        def end(key: Any, away: float) -> PyTree:
            return grad(key, jax.tree.map(lambda a, b: a + away * b, x, v), *args)

        ends = end(keys[0], step), end(keys[1], -step)
        return jax.tree.map(lambda a, b: (a - b) / (2 * step), *ends)

    return g
