"""What to subtract from the function, so that the weights meet small numbers."""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from smoothdiff._draws import Draws
from smoothdiff._noise import NoiseSampler


class Control(eqx.Module):
    """A baseline at work: what it leaves of the samples, and what the estimate gets back.

    `residual` holds f(x_i) - b_i for each sample. It is not a stopped gradient: with respect to
    other arguments of the function the baseline moves with the samples, so mixed derivatives keep
    its variance reduction.
    """

    residual: eqx.AbstractVar[PyTree]

    def errors(self) -> PyTree:
        """The residuals with each sample left out of its own baseline, for standard errors.

        A fit to all samples leaves residuals that are too small for those.
        """
        return self.residual

    @abc.abstractmethod
    def smoothed(self, shift: Float[Array, " n"], ratio: Float[Array, " n"] | None) -> PyTree:
        """The smoothed baseline, averaged over samples, at displaced parameters (`_estimate`)."""


class Constant(Control):
    """A baseline that is a number for each sample: `mean` is their average."""

    residual: PyTree
    mean: PyTree

    def smoothed(self, shift: Array, ratio: Array | None) -> PyTree:
        """A constant stays what it is."""
        return self.mean


class AbstractBaseline(eqx.Module):
    r"""Decides what is subtracted from each sample.

    $$ \hat F = \frac1N \sum_i w_i (f_i - b_i) + \mathbb{E}[w b] $$

    An estimate stays unbiased when what is subtracted from sample i does not depend on sample i.
    `termwise` says that what is subtracted from a term is a constant, so that the parameters which
    cannot influence the term are not blamed for the baseline either. `slope` says that it needs the
    derivative by AD at theta, with respect to z, in place of f(theta).

    Example:
        >>> import jax, jax.numpy as jnp, smoothdiff as sd
        >>> g = sd.smooth_grad(jnp.sum, 0.5, baseline=sd.LeastSquares(1), num_samples=64)
        >>> isinstance(sd.LeastSquares(1), sd.AbstractBaseline)
        True
        >>> print(g(jax.random.key(0), jnp.ones(2)).round(3))
        [1. 1.]

    Source: own.
    """

    termwise: ClassVar[bool] = True
    slope: ClassVar[bool] = False

    def evaluations(self) -> int:
        """Evaluations of the function, out of `num_samples`, that the baseline itself needs."""
        return 0

    def check_gaussian(self, draws: Draws) -> None:
        """Raises ValueError where another kernel than the Gaussian smooths."""
        if isinstance(draws.sampler, NoiseSampler):
            raise ValueError(
                f"{self} knows its own smoothed value for Gaussian smoothing only: use "
                f'baseline="mean" with noise={draws.sampler.noise!r}'
            )

    @abc.abstractmethod
    def __call__(
        self,
        values: PyTree,
        draws: Draws,
        log_ratio: Float[Array, " N"] | None,
        valid: Bool[Array, " N"] | None,
        center: PyTree,
    ) -> Control:
        """Subtracts the baseline from `values`, whose leaves have one leading row per sample.

        `center` is f(theta), or its slope, if `evaluations()` asked for it, else None. Traced by
        JAX, always: no value can be looked at.
        """


class NoBaseline(AbstractBaseline):
    """Subtracts nothing."""

    def __call__(self, values, draws, log_ratio, valid, center):
        return Constant(values, jax.tree.map(lambda v: jnp.zeros(v.shape[1:], v.dtype), values))


class Mean(AbstractBaseline):
    """Subtracts the mean of the other samples, with all that depends on a sample left out.

    Leaving out only the sample itself would be biased for antithetic pairs: the gradient by
    N/(N-1), the Hessian by (N-2)/(N-1). A set that is a single group has no others, and then
    nothing is subtracted. For a single scrambled point set it is the plain mean: leaving samples
    out of an even set makes it uneven, a bias of 14 % at N = 8 where that of the mean is 0.7 %.
    With fewer samples the gradient is short by 3 % (N = 4), 14 % (3) and 18 % (2); nothing
    subtracted would be unbiased, and far less accurate beside any offset. A single point, or pair,
    is no set. More bias is left if the points of the one set are weighted (`Aggregate` with
    `quasi=True`), and in the Hessian, above all if they are mirrored (`Sobol(antithetic=True)`).
    """

    def __call__(self, values, draws, log_ratio, valid, center):
        group = draws.sampler.group(draws.num, draws.n)
        whole = group >= draws.num
        # one point, or one with its mirror image, less its own mean is nothing at all
        alone = draws.num <= draws.sampler.block(draws.num, draws.n)
        if whole and (alone or not draws.sampler.balanced):
            return NoBaseline()(values, draws, log_ratio, valid, center)
        ids = np.arange(draws.num) // group
        weight = jnp.ones(draws.num, draws.dtype) if log_ratio is None else jnp.exp(log_ratio)
        if valid is not None:
            weight = jnp.where(valid, weight, 0)

        def others(total_of: Array) -> Array:
            """Sums over all rows outside each row's own group, or over all rows of a single set."""
            if whole:
                total = jnp.sum(total_of, axis=0, keepdims=True)
                return jnp.broadcast_to(total, total_of.shape)
            sums = jax.ops.segment_sum(total_of, ids, num_segments=int(ids[-1]) + 1)
            return (jnp.sum(sums, axis=0, keepdims=True) - sums)[ids]

        count = others(weight)
        divisor = count if valid is None else jnp.where(count > 0, count, 1)

        def leave_out(v: Array) -> tuple[Array, Array]:
            # removing the common level first keeps the rounding of a large offset out of the sums
            w = weight.astype(v.dtype).reshape(-1, *[1] * (v.ndim - 1))
            level = jnp.sum(w * v, axis=0) / jnp.sum(w)
            small = v - level[None]
            rest = others(w * small) / divisor.astype(v.dtype).reshape(w.shape)
            if valid is None:
                return small - rest, level + jnp.mean(rest, axis=0)
            # where all others were dropped there is no mean of them, and nothing is subtracted
            rest = jnp.where((count > 0).reshape(w.shape), rest, -level[None])
            share = valid.astype(v.dtype).reshape(w.shape)
            return small - rest, level + jnp.sum(share * rest, axis=0) / jnp.sum(share)

        leaves, treedef = jax.tree.flatten(values)
        residual, mean = zip(*map(leave_out, leaves), strict=True)
        return Constant(treedef.unflatten(residual), treedef.unflatten(mean))


class Center(AbstractBaseline):
    """Subtracts f(theta), the function at the unperturbed parameters, which is one evaluation."""

    def evaluations(self) -> int:
        return 1

    def __call__(self, values, draws, log_ratio, valid, center):
        return Constant(jax.tree.map(lambda v, c: v - c[None], values, center), center)
