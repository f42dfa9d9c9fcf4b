"""A quadratic model of the smoothed function from one batch: value, gradient, Hessian operator."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float, PyTree

from smoothdiff._batch import Batch
from smoothdiff._estimate import objective
from smoothdiff._layout import Layout
from smoothdiff._products import dot
from smoothdiff._stderr import grad_stderr, hvp_stderr, value_stderr


class HessianOperator(lx.AbstractLinearOperator):
    r"""The Hessian of the smoothed function as a linear operator that holds only arrays.

    $$ H v = \frac1N \sum_i w_i (f_i - b_i) \, \frac{z_i (z_i \cdot v) - v}{\sigma^2} $$

    A product reads the stored points twice and evaluates the function not at all. It is symmetric,
    and indefinite in general.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> f = lambda x: x[0] ** 2 + 3 * x[0] * x[1]
        >>> g = sd.smooth_quadratic(f, 0.5, baseline="quadratic")
        >>> model = g(jax.random.key(0), jnp.ones(2))
        >>> print(model.hessian.mv(jnp.array([1.0, 0.0])).round(2))
        [2. 3.]

    Source: Stochastic Gradient Estimation for Higher-order Differentiable Rendering, eq. 22.
    """

    batch: Batch
    sigma: Float[Array, " n"]
    layout: Layout = eqx.field(static=True)

    def mv(self, vector: PyTree) -> PyTree:
        """The product with a vector of the structure and shapes of the parameters."""
        return self.layout.tree(self._product(self._scaled(vector)) / self.sigma)

    def _scaled(self, vector: PyTree) -> Float[Array, " n"]:
        self.layout.check_vector(vector)
        return self.layout.vector(jax.tree.leaves(vector)) / self.sigma

    def _product(self, direction: Float[Array, " n"]) -> Float[Array, " n"]:
        # in units of sigma
        gradient = jax.grad(lambda shift: objective(self.batch, shift))
        return jax.jvp(gradient, (jnp.zeros_like(direction),), (direction,))[1]

    def stderr(self, vector: PyTree) -> PyTree:
        """The standard error of `mv(vector)`, elementwise and of the same structure."""
        scaled = self._scaled(vector)
        error = hvp_stderr(self.batch, scaled, self._product(scaled))
        return self.layout.tree(error / self.sigma)

    def as_matrix(self) -> Float[Array, "n n"]:
        """The n x n matrix; this is the only method that builds one."""
        unit = jnp.eye(self.sigma.size, dtype=self.sigma.dtype)
        return jax.vmap(self._product)(unit) / (self.sigma[:, None] * self.sigma[None, :])

    def transpose(self) -> "HessianOperator":
        return self

    def in_structure(self) -> PyTree[jax.ShapeDtypeStruct]:
        return jax.eval_shape(self.layout.tree, self.sigma)

    def out_structure(self) -> PyTree[jax.ShapeDtypeStruct]:
        return self.in_structure()


@lx.is_symmetric.register(HessianOperator)
def _(operator: HessianOperator) -> bool:
    return True


for _property in (
    lx.is_diagonal,
    lx.is_tridiagonal,
    lx.has_unit_diagonal,
    lx.is_lower_triangular,
    lx.is_upper_triangular,
    lx.is_positive_semidefinite,
    lx.is_negative_semidefinite,
):
    _property.register(HessianOperator)(lambda operator: False)

for _same in (lx.linearise, lx.conj):
    _same.register(HessianOperator)(lambda operator: operator)


@lx.materialise.register(HessianOperator)
def _(operator: HessianOperator) -> lx.AbstractLinearOperator:
    return lx.PyTreeLinearOperator(
        jax.jacfwd(operator.mv)(operator.layout.tree(jnp.zeros_like(operator.sigma))),
        operator.out_structure(),
        lx.symmetric_tag,
    )


@lx.diagonal.register(HessianOperator)
def _(operator: HessianOperator) -> Array:
    return jnp.diagonal(operator.as_matrix())


class QuadraticModel(eqx.Module):
    r"""The second-order model of a smoothed scalar function around its parameters.

    $$ F(\theta + p) \approx F(\theta) + \nabla F \cdot p + \tfrac12 p \cdot \nabla^2 F \, p $$

    Made by [`smooth_quadratic`][smoothdiff.smooth_quadratic] from one batch of evaluations. It
    holds only arrays, so it crosses `jit`, `vmap` and `scan`.

    Attributes:
        value: the smoothed value, a scalar.
        grad: the gradient, like the parameters.
        hessian: a symmetric `lineax` operator on vectors that are like the parameters.

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> f = lambda x: x[0] ** 2 + 3 * x[0] * x[1]
        >>> g = sd.smooth_quadratic(f, 0.5, baseline="quadratic")
        >>> model = g(jax.random.key(0), jnp.ones(2))
        >>> print(f"{model.value:.2f}", model.grad.round(2))  # of f it is 4, of F 4 + 0.5²
        4.25 [5. 3.]

    Source: Stochastic Gradient Estimation for Higher-order Differentiable Rendering, eq. 17-22.
    """

    value: Float[Array, ""]
    grad: PyTree
    hessian: HessianOperator

    @property
    def stderr(self) -> tuple[Float[Array, ""], PyTree]:
        """The standard errors of `value` and `grad`."""
        batch, sigma = self.hessian.batch, self.hessian.sigma
        layout = self.hessian.layout
        scaled = layout.vector(jax.tree.leaves(self.grad)) * sigma
        error = grad_stderr(batch, scaled) / sigma
        return value_stderr(batch, self.value), layout.tree(error)

    def hessian_stderr(self, v: PyTree) -> PyTree:
        """The standard error of `hessian.mv(v)`, elementwise."""
        return self.hessian.stderr(v)

    def __call__(self, step: PyTree) -> Array:
        """The model's value at the parameters plus `step`."""
        half = jax.tree.map(lambda g, h: g + h / 2, self.grad, self.hessian.mv(step))
        dots = jax.tree.map(lambda a, b: dot(jnp.ravel(a), jnp.ravel(b)), half, step)
        return self.value + _sum(jax.tree.leaves(dots), self.value.dtype)


def _sum(terms: list[Any], dtype) -> Array:
    return jnp.sum(jnp.stack([term.astype(dtype) for term in terms]))
