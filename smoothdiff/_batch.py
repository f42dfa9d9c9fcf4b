"""Evaluating the function at sampled points: the only place that calls it."""

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.sharding import NamedSharding
from jaxtyping import Array, PyTree

from smoothdiff._baselines import AbstractBaseline, Control
from smoothdiff._draws import Draws
from smoothdiff._layout import Layout
from smoothdiff._numbers import at_least_float32
from smoothdiff._params import Params
from smoothdiff._samplers import AbstractSampler
from smoothdiff._seen import Seen
from smoothdiff._sharding import shared_out
from smoothdiff._support import AbstractSupport, check_support


class Batch(eqx.Module):
    """Points with the function's values there; arrays only, so that it crosses jit and scan.

    `values` and `aux` have one leading row per sample; an aux that is `Seen` has one per chunk, the
    lowest. `scale` is one over the number of samples
    that count, or NaN where the estimate is void. `valid` marks the samples that count, None if
    all do. `layout` says which parameter is where in a point.
    """

    draws: Draws
    values: PyTree
    control: Control
    log_ratio: Array | None
    valid: Array | None
    scale: Array
    aux: PyTree
    support: AbstractSupport | None
    layout: Layout = eqx.field(static=True)

    def without_aux(self) -> "Batch":
        """The batch for a model that keeps it; aux can be large and says nothing of derivatives."""
        return replace(self, aux=None)


def evaluate(
    fun: Callable[[Array, list], tuple[PyTree, PyTree]],
    params: Params,
    key: Array,
    *,
    num_samples: int,
    sampler: AbstractSampler,
    baseline: AbstractBaseline,
    batch_size: int | None,
    nonfinite: Literal["propagate", "drop"],
    sharding: NamedSharding | None = None,
    support: AbstractSupport | None = None,
    free_rows: list | None = None,
) -> Batch:
    """Draws points around the parameters and evaluates `fun(theta, free) -> (value, aux)` there.

    The points are stopped gradients, so that neither AD nor a callback's missing derivative
    follows the function through them. `free_rows` gives each sample its own copy of the leaves
    that are not smoothed.
    """
    theta, sigma = jax.lax.stop_gradient((params.theta, params.sigma))
    extra = baseline.evaluations()
    try:
        draws = Draws(
            sampler, key, num_samples - extra, theta.size, theta.dtype, batch_size, sharding
        )
    except ValueError as error:
        if extra:
            error.add_note(f"{extra} of num_samples={num_samples} is for the baseline, f(theta)")
        raise
    free = params.free if free_rows is None else free_rows

    def row(z: Array, free: list):
        # the function sees the clamped point; the weights will see the unclamped z
        return fun(params.clip(theta + sigma * z), free)

    def rows(z: Array, log_ratio: Array | None):
        values, aux = jax.vmap(row, in_axes=(0, None if free_rows is None else 0))(z, free)
        values = jax.tree.map(at_least_float32, values)
        if isinstance(aux, Seen):
            # here, so that points need no more memory than a chunk of them
            aux = jax.tree.map(lambda a: a[None], aux.lowest())
        return values, aux, log_ratio

    values, aux, log_ratio = draws.map(rows)
    values = shared_out(values, sharding)
    _check_values(values)
    center = None
    if baseline.slope:
        center = _slope(lambda z: row(z, params.free)[0], jnp.zeros_like(theta))
    elif extra:
        center = jax.tree.map(at_least_float32, fun(params.clip(theta), params.free)[0])
    if support is not None:
        if params.free:
            raise ValueError("support needs a sigma for every leaf of the parameters")
        support = support.at(params.layout.tree(theta))
        _check_support(support, params, baseline, values, log_ratio)
    valid = None
    if nonfinite == "drop":
        # nothing is subtracted where there is no such value
        center = jax.tree.map(lambda c: jnp.where(jnp.isfinite(c), c, 0), center)
        valid = jnp.stack([_finite(v) for v in jax.tree.leaves(values)]).all(axis=0)
        values = jax.tree.map(lambda v: jnp.where(_like(valid, v), v, 0), values)
    # compiled as a whole even where the caller does not jit: op by op that takes seconds
    control = eqx.filter_jit(baseline)(values, draws, log_ratio, valid, center)
    if valid is None:
        scale = jnp.full((), 1 / draws.num, theta.dtype)
    else:
        masked = jax.tree.map(lambda r: jnp.where(_like(valid, r), r, 0), control.residual)
        control = eqx.tree_at(lambda c: c.residual, control, masked)
        count = jnp.sum(valid).astype(theta.dtype)
        scale = jnp.where(2 * count >= draws.num, 1 / count, jnp.nan)
    if params.sound is not None:
        scale = jnp.where(params.sound, scale, jnp.nan)
    return Batch(draws, values, control, log_ratio, valid, scale, aux, support, params.layout)


def _slope(fun: Callable[[Array], PyTree], z: Array) -> Array:
    """The derivative by AD of a function that returns one number."""
    leaves = jax.tree.leaves(jax.eval_shape(fun, z))
    if [leaf.shape for leaf in leaves] != [()]:
        raise ValueError(
            'baseline="ad" is for functions that return one number: return a loss, or use '
            'baseline="auto"'
        )
    return jax.grad(lambda z: jax.tree.leaves(fun(z))[0])(z)


def _like(rows: Array, values: Array) -> Array:
    return rows.reshape(-1, *[1] * (values.ndim - 1))


def _finite(values: Array) -> Array:
    return jnp.isfinite(values).reshape(values.shape[0], -1).all(axis=1)


def _check_values(values: PyTree) -> None:
    if not jax.tree.leaves(values):
        raise TypeError(
            f"the function returned {values}, in which there is no array: return what is to be "
            "smoothed"
        )
    for leaf in jax.tree.leaves(values):
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            raise TypeError(
                f"the function returned dtype {leaf.dtype}; a smoothed function must return "
                "real floating-point values: use .astype(float)"
            )


def _check_support(
    support: AbstractSupport,
    params: Params,
    baseline: AbstractBaseline,
    values: PyTree,
    log_ratio: Array | None,
) -> None:
    if log_ratio is not None:
        raise ValueError(
            "support needs points that are normal themselves: a sampler such as Gaussian or Sobol, "
            "and no noise"
        )
    if not baseline.termwise:
        raise ValueError('support goes with baseline="mean", "center" or "none"')
    row = jax.tree.map(lambda v: jax.ShapeDtypeStruct(v.shape[1:], v.dtype), values)
    check_support(support, params.layout.tree(params.theta), row)
