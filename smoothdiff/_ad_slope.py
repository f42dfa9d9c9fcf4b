"""The baseline "ad": AD where it holds, samples for the rest."""

from typing import ClassVar

import jax
import jax.numpy as jnp

from smoothdiff._baselines import AbstractBaseline, Mean
from smoothdiff._least_squares import PolynomialControl
from smoothdiff._products import dot


class ADSlope(AbstractBaseline):
    r"""Subtracts the function as AD sees it: the linear one with its slope at the parameters.

    $$ b(z) = \bar f + \sigma \nabla_{\text{AD}} f(\theta) \cdot z, \qquad
       \mathbb{E}_u[b(m + s u)] = \bar f + \sigma \nabla_{\text{AD}} f(\theta) \cdot m $$

    What AD says is exact for shading, and lacks the moving edges of what covers what; samples of
    what is left are only about these. $\bar f$ is the mean of the other samples of $f - b$. As the
    slope is not that of a sample, the estimate is unbiased for the smoothed function whatever AD
    says, zeros and nonsense included: a bad slope costs accuracy.

    One of the evaluations is that of the function with its gradient, at the parameters. The
    function returns one number; a `jax.custom_vjp` is where a renderer's own gradient goes.

    Source: own; a control variate with a known mean.
    """

    termwise: ClassVar[bool] = False
    slope: ClassVar[bool] = True

    def evaluations(self) -> int:
        """One, with its gradient."""
        return 1

    def __call__(self, values, draws, log_ratio, valid, center):
        self.check_gaussian(draws)
        (leaf,), treedef = jax.tree.flatten(values)
        along = lambda z, _: dot(z, center)
        small = leaf - draws.map(along).astype(leaf.dtype)
        rest = Mean()(small, draws, log_ratio, valid, None)
        coefficients = jnp.append(rest.mean, center.astype(rest.mean.dtype))
        residual = treedef.unflatten([rest.residual])
        return PolynomialControl(residual, residual, treedef.unflatten([coefficients]), "linear")
