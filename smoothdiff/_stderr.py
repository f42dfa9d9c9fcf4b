r"""Standard errors: how far the independent groups of samples spread around their mean.

Every estimate is a ratio of sums over groups, $\hat e = \sum_g s_g / \sum_g n_g$, with $n_g$
samples in group g; its standard error is
$\sqrt{\tfrac{G}{G-1} \sum_g (s_g - n_g \hat e)^2} / \sum_g n_g$.
What the smoothed baseline adds to an estimate is in no row, so it is not in $\hat e$ either.

A single scrambled point set has one group; its points then count as independent, which is too wide:
the 95 % interval of a gradient reaches 4.8 times the RMSE to either side with the baseline "mean",
2.9 times with "gp", where about 2 would do (`python -m benchmarks variance --full`, ten dimensions,
N = 256). R scrambled sets are R groups, and Student's t has R - 1 degrees of freedom.

All is computed in units of sigma and of the largest residual, so that squares neither overflow nor
vanish.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from smoothdiff._baselines import Constant
from smoothdiff._batch import Batch
from smoothdiff._estimate import weigh, weights


@eqx.filter_jit
def value_stderr(batch: Batch, estimate: PyTree) -> PyTree:
    """The standard error of the smoothed value, leaf by leaf; of the sum of terms for a scalar."""

    constant = isinstance(batch.control, Constant)

    def leaf(values: Array, residual: Array, known: Array, mean: Array) -> Array:
        def sums(z, log_ratio, rows, shift):
            value, rest = rows
            out = weigh(weights(batch, z, log_ratio, shift), rest)
            if constant:
                # each row's own number comes back: for plain Gaussian points that is f itself
                out += value - rest
            flat = out.reshape(len(out), -1)
            return flat if mean.ndim else jnp.sum(flat, axis=1, keepdims=True)

        back = jnp.zeros_like(known) if constant else known
        center = (mean - (back if mean.ndim else jnp.sum(back))).reshape(-1)
        scale = _largest(residual)
        return _spread(batch, sums, (values, residual), center, scale).reshape(mean.shape)

    known = _known(batch)(_no_shift(batch))
    return jax.tree.map(leaf, batch.values, batch.control.errors(), known, estimate)


@eqx.filter_jit
def jacobian_stderr(batch: Batch, estimate: PyTree) -> PyTree:
    """The standard error of the derivative in units of sigma; leaves (..., n) like `estimate`."""

    def leaf(residual: Array, known: Array, mean: Array) -> Array:
        columns = (mean - known).reshape(-1, mean.shape[-1]).T
        scale = _largest(residual)

        def column(direction: Array, column_mean: Array) -> Array:
            def sums(z, log_ratio, rows, shift):
                tangent = jnp.broadcast_to(direction, shift.shape)
                moved = lambda s: weigh(weights(batch, z, log_ratio, s), rows)
                return jax.jvp(moved, (shift,), (tangent,))[1].reshape(len(rows), -1)

            return _spread(batch, sums, residual, column_mean, scale)

        n = mean.shape[-1]
        out = jax.lax.map(lambda a: column(*a), (jnp.eye(n, dtype=batch.draws.dtype), columns))
        return out.T.reshape(mean.shape)

    known = jax.jacfwd(_known(batch))(_no_shift(batch))
    return jax.tree.map(leaf, batch.control.errors(), known, estimate)


@eqx.filter_jit
def grad_stderr(batch: Batch, estimate: Float[Array, " n"]) -> Float[Array, " n"]:
    """The standard error of the gradient in units of sigma, for a scalar function."""
    residual = batch.control.errors()
    sums = lambda z, log_ratio, rows, shift: _row_grad(batch, z, log_ratio, rows)(shift)
    known = jax.grad(_known_sum(batch))(_no_shift(batch))
    return _spread(batch, sums, residual, estimate - known, _largest(residual))


@eqx.filter_jit
def hvp_stderr(
    batch: Batch, direction: Float[Array, " n"], estimate: Float[Array, " n"]
) -> Float[Array, " n"]:
    """The standard error of the Hessian-vector product in units of sigma, for a scalar function."""
    residual = batch.control.errors()

    def sums(z, log_ratio, rows, shift):
        tangent = jnp.broadcast_to(direction, shift.shape)
        return jax.jvp(_row_grad(batch, z, log_ratio, rows), (shift,), (tangent,))[1]

    known = jax.jvp(jax.grad(_known_sum(batch)), (_no_shift(batch),), (direction,))[1]
    return _spread(batch, sums, residual, estimate - known, _largest(residual))


@eqx.filter_jit
def free_grad_stderr(batch: Batch, per_row: Array) -> tuple[Array, Array]:
    """Sum and standard error of a derivative by AD that is given in parts, one for each sample."""
    if jnp.iscomplexobj(per_row):
        # both parts have an error of their own
        parts = free_grad_stderr(batch, jnp.stack([per_row.real, per_row.imag], axis=1))
        mean, error = (jax.lax.complex(part[0], part[1]) for part in parts)
        return mean, error
    flat = per_row.reshape(len(per_row), -1)
    mean = jnp.sum(flat, axis=0)
    rows = flat / batch.scale.astype(flat.dtype)
    sums = lambda z, log_ratio, rows, shift: rows
    error = _spread(batch, sums, rows, mean, _largest(rows))
    return mean.reshape(per_row.shape[1:]), error.reshape(per_row.shape[1:])


def _largest(rows: Array) -> Array:
    """The largest magnitude, 0 where there is no number."""
    return jnp.max(jnp.abs(rows), initial=0)


def _no_shift(batch: Batch) -> Float[Array, " n"]:
    return jnp.zeros(batch.draws.n, batch.draws.dtype)


def _known(batch: Batch) -> Callable[[Array], PyTree]:
    """The smoothed baseline at displaced parameters, which is no part of any sample's row."""
    return lambda shift: batch.control.smoothed(shift, None)


def _known_sum(batch: Batch) -> Callable[[Array], Array]:
    return lambda shift: jnp.sum(_known(batch)(shift))


def _row_grad(
    batch: Batch, z: Array, log_ratio: Array | None, rows: Array
) -> Callable[[Array], Array]:
    # each row has a displacement of its own, so one reverse pass gives the gradient of every row
    def total(shift: Array) -> Array:
        return jnp.sum(weigh(weights(batch, z, log_ratio, shift), rows))

    return jax.grad(total)


def _spread(batch: Batch, sums: Callable, rows: PyTree, mean: Array, scale: Array) -> Array:
    """The standard error of a mean of rows `sums(z, log_ratio, rows, shift) -> (m, k)`."""
    draws = batch.draws
    group = draws.sampler.group(draws.num, draws.n)
    count = -(-draws.num // group)
    if count < 2 and draws.sampler.balanced:
        # one scrambled set: as if its points were independent, which is too wide but never narrow
        group, count = draws.sampler.block(draws.num, draws.n), draws.num
    if count < 2:
        raise ValueError(
            f"a standard error needs at least two independent groups of samples, and {draws.num} "
            f"samples of {draws.sampler} are one: raise num_samples"
        )
    safe = jnp.where(scale > 0, scale, 1).astype(mean.dtype)

    def deviations(z, log_ratio, valid, rows) -> Array:
        out: Array = sums(z, log_ratio, rows, jnp.zeros(z.shape, z.dtype)).astype(mean.dtype)
        away = (out - mean[None]) / safe
        return away if valid is None else jnp.where(valid[:, None], away, 0)

    if draws.chunk % group == 0:

        def squares(start, z, log_ratio, part):
            away = deviations(z, log_ratio, *part)
            ids = jnp.arange(z.shape[0]) // group
            sums = jax.ops.segment_sum(away, ids, num_segments=-(-z.shape[0] // group))
            return jnp.sum(sums**2, axis=0)

        total = draws.sum(squares, (batch.valid, rows))
    else:
        # groups longer than a chunk are few, so their sums can be kept
        def by_group(start, z, log_ratio, part):
            away = deviations(z, log_ratio, *part)
            ids = (start + jnp.arange(z.shape[0])) // group
            return jax.ops.segment_sum(away, ids, num_segments=count)

        total = jnp.sum(draws.sum(by_group, (batch.valid, rows)) ** 2, axis=0)
    error = jnp.sqrt(total * (count / (count - 1))) * safe
    return error * batch.scale.astype(error.dtype)
