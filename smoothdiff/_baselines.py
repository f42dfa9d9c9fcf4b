"""What to subtract from the function, so that the weights meet small numbers."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from smoothdiff._draws import Draws


class Control(eqx.Module):
    """A baseline at work: what it leaves of the samples, and the constant that it took away.

    `residual` holds f(x_i) - b_i for each sample, `mean` the average of the b_i, which the estimate
    gets back. Neither is a stopped gradient: with respect to other arguments of the function the
    baseline moves with the samples, so mixed derivatives keep its variance reduction.
    """

    residual: PyTree
    mean: PyTree


class AbstractBaseline(eqx.Module):
    """Decides what is subtracted from each sample.

    An estimate stays unbiased when what is subtracted from sample i does not depend on sample i.
    """

    def evaluations(self) -> int:
        """Evaluations of the function, out of `num_samples`, that the baseline itself needs."""
        return 0

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

        `center` is f(theta) if `evaluations()` asked for it, else None.
        """


class NoBaseline(AbstractBaseline):
    """Subtracts nothing."""

    def __call__(self, values, draws, log_ratio, valid, center):
        return Control(values, jax.tree.map(lambda v: jnp.zeros(v.shape[1:], v.dtype), values))


class MeanOfOthers(AbstractBaseline):
    """Subtracts the mean of the other samples, with all that depends on a sample left out.

    Leaving out only the sample itself would be biased for antithetic pairs: the gradient by
    N/(N-1), the Hessian by (N-2)/(N-1). A set that is a single group has no others, and then
    nothing is subtracted.
    """

    def __call__(self, values, draws, log_ratio, valid, center):
        group = draws.sampler.group(draws.num, draws.n)
        if group >= draws.num:
            return NoBaseline()(values, draws, log_ratio, valid, center)
        ids = np.arange(draws.num) // group
        weight = jnp.ones(draws.num, draws.dtype) if log_ratio is None else jnp.exp(log_ratio)
        if valid is not None:
            weight = jnp.where(valid, weight, 0)

        def others(total_of: Array) -> Array:
            """Sums over all rows outside each row's own group."""
            sums = jax.ops.segment_sum(total_of, ids, num_segments=int(ids[-1]) + 1)
            return (jnp.sum(sums, axis=0, keepdims=True) - sums)[ids]

        count = others(weight)

        def leave_out(v: Array) -> tuple[Array, Array]:
            # removing the common level first keeps the rounding of a large offset out of the sums
            w = weight.astype(v.dtype).reshape(-1, *[1] * (v.ndim - 1))
            level = jnp.sum(w * v, axis=0) / jnp.sum(w)
            small = v - level[None]
            rest = others(w * small) / count.astype(v.dtype).reshape(w.shape)
            if valid is None:
                return small - rest, level + jnp.mean(rest, axis=0)
            share = valid.astype(v.dtype).reshape(w.shape)
            return small - rest, level + jnp.sum(share * rest, axis=0) / jnp.sum(share)

        leaves, treedef = jax.tree.flatten(values)
        residual, mean = zip(*map(leave_out, leaves), strict=True)
        return Control(treedef.unflatten(residual), treedef.unflatten(mean))


class Center(AbstractBaseline):
    """Subtracts f(theta), the function at the unperturbed parameters, which is one evaluation."""

    def evaluations(self) -> int:
        return 1

    def __call__(self, values, draws, log_ratio, valid, center):
        return Control(jax.tree.map(lambda v, c: v - c[None], values, center), center)


_NAMED = {"none": NoBaseline, "mean": MeanOfOthers, "center": Center}


def as_baseline(baseline: str | AbstractBaseline) -> AbstractBaseline:
    """The baseline that a name stands for."""
    if isinstance(baseline, AbstractBaseline):
        return baseline
    if baseline in _NAMED:
        return _NAMED[baseline]()
    raise ValueError(f"baseline must be one of {sorted(_NAMED)} or an object, not {baseline!r}")
