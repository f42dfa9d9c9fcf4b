"""Spatiotemporal filtering of gradients, as optax transformations.

Adam filters the gradient in time; these also filter it in space, before that or after it. They map
the filter over all leaves that they see, with the leaf of the parameters as guide: where only some
leaves are images, `optax.masked` or `optax.multi_transform` chooses them.
"""

from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Int, PyTree

from smoothdiff._numbers import at_least_float32
from smoothdiff._params import is_concrete
from smoothdiff.filters.grid import Filter, Scale


class FilteredAdamState(NamedTuple):
    """What `scale_by_filtered_adam` remembers; None for what its settings do not need."""

    step: Int[Array, ""] | None
    m: PyTree
    v: PyTree


def filter_updates(filter: Filter) -> optax.GradientTransformationExtraArgs:
    r"""Filters the updates in space; keeps no state.

    $$ u \leftarrow \text{filter}(u, \theta) $$

    Args:
        filter: maps signal and guide to the filtered signal, see `smoothdiff.filters`.

    Returns:
        A transformation, whose `update` needs the parameters.

    Raises:
        ValueError: in `update`, without the parameters.

    Example:
        >>> import jax.numpy as jnp
        >>> import optax
        >>> import smoothdiff as sd
        >>> smooth = sd.filters.cross_bilateral(0.1, 3, ndim=2)
        >>> optimiser = optax.chain(sd.filter_updates(smooth), optax.sgd(0.1))
        >>> image = jnp.zeros((8, 8, 3))
        >>> state = optimiser.init(image)
        >>> updates, state = optimiser.update(jnp.ones_like(image), state, image)

    Source: Chang et al. 2024, Spatiotemporal Bilateral Gradient Filtering for Inverse Rendering,
    section 4.1.
    """

    def update(updates: Any, state: Any, params: Any = None, **extra_args: Any) -> tuple[Any, Any]:
        return _filtered(filter, updates, params), state

    return optax.GradientTransformationExtraArgs(lambda params: optax.EmptyState(), update)


def scale_by_filtered_adam(
    b1: Scale = 0.9,
    b2: Scale = 0.999,
    eps: Scale = 1e-8,
    prefilter: Filter | None = None,
    postfilter: Filter | None = None,
    second_moment: Literal["filter", "max", "none"] = "filter",
) -> optax.GradientTransformationExtraArgs:
    r"""Adam's scaling with filters in space before and after its averages over time.

    $$ g \leftarrow \mathrm{pre}(g), \quad m \leftarrow \beta_1 m + (1 - \beta_1) g, \quad
       v \leftarrow \beta_2 v + (1 - \beta_2) g^2 $$

    $$ \mathrm{update} = \frac{\mathrm{post}(m) / (1 - \beta_1^t)}
        {\sqrt{\mathrm{post}(v) / (1 - \beta_2^t)} + \epsilon} $$

    The parameters guide both filters. Both moments get the same weights, so |post(m)| /
    sqrt(post(v)) is at most the largest |m| / sqrt(v): steps are as bounded as Adam's. Without
    filters it is Adam.

    Args:
        b1: how much of the first moment a step keeps. On grids the paper has 0.2 to 0.5.
        b2: how much of the second moment a step keeps. On grids the paper has 1 - b1 =
            sqrt(1 - b2). With b1 or b2 the number 0 (not an array), that moment takes no memory.
        eps: keeps the quotient finite.
        prefilter: filters the gradient.
        postfilter: filters the moments.
        second_moment: "filter" filters v like m, "max" takes the largest v of each leaf instead
            (UniformAdam), "none" does not divide by it. With `optax.inject_hyperparams`, name
            prefilter, postfilter and second_moment in its static_args.

    Returns:
        A transformation, whose `update` needs the parameters if there is a filter.

    Raises:
        ValueError: for b1 or b2 outside [0, 1), another second_moment; in `update`, for filters
            without the parameters.

    Example:
        >>> import jax.numpy as jnp
        >>> import optax
        >>> import smoothdiff as sd
        >>> smooth = sd.filters.cross_bilateral(0.1, 5, ndim=2, log=True)
        >>> adam = sd.scale_by_filtered_adam(b1=0.2, b2=0.36, postfilter=smooth)
        >>> optimiser = optax.chain(adam, optax.scale_by_learning_rate(0.1))
        >>> roughness = jnp.full((8, 8), 0.5)
        >>> state = optimiser.init(roughness)
        >>> updates, state = optimiser.update(jnp.ones_like(roughness), state, roughness)

    Source: Chang et al. 2024, Spatiotemporal Bilateral Gradient Filtering for Inverse Rendering,
    algorithms 2 and 3.
    """
    for name, value in (("b1", b1), ("b2", b2)):
        if is_concrete(value) and not 0 <= value < 1:
            raise ValueError(f"{name}={value} must be at least 0 and less than 1")
    if second_moment not in ("filter", "max", "none"):
        raise ValueError(f'second_moment={second_moment!r} must be "filter", "max" or "none"')
    keep_m, keep_v = _remembers(b1), second_moment != "none" and _remembers(b2)

    zeros = lambda x: jnp.zeros_like(at_least_float32(x))

    def init(params: Any) -> Any:
        return FilteredAdamState(
            step=jnp.zeros((), jnp.int32) if keep_m or keep_v else None,
            m=jax.tree.map(zeros, params) if keep_m else None,
            v=jax.tree.map(zeros, params) if keep_v else None,
        )

    def update(updates: Any, state: Any, params: Any = None, **extra_args: Any) -> tuple[Any, Any]:
        step: Any = optax.safe_increment(state.step) if keep_m or keep_v else None
        given, fine = updates, lambda tree: jax.tree.map(at_least_float32, tree)
        updates, params = fine(updates), fine(params)
        g = _filtered(prefilter, updates, params)
        m = _average(b1, g, state.m) if keep_m else g
        scaled = _filtered(postfilter, m, params)
        if keep_m:
            scaled = _unbiased(b1, scaled, step)
        v = None
        if second_moment != "none":
            square = jax.tree.map(jnp.square, g)
            v = _average(b2, square, state.v) if keep_v else square
            if second_moment == "max":
                bound = jax.tree.map(lambda v: jnp.max(v, initial=0), v)
            else:
                bound = _filtered(postfilter, v, params)
            if keep_v:
                bound = _unbiased(b2, bound, step)
            # rounding in a filter may leave v a little below zero
            scaled = jax.tree.map(
                lambda m, v: m / (jnp.sqrt(jnp.abs(v)) + _scalar(eps, m)), scaled, bound
            )
        scaled = jax.tree.map(lambda new, like: new.astype(jnp.asarray(like).dtype), scaled, given)
        return scaled, FilteredAdamState(step, m if keep_m else None, v if keep_v else None)

    return optax.GradientTransformationExtraArgs(init, update)


def filtered_adam(
    learning_rate: optax.ScalarOrSchedule,
    b1: Scale = 0.9,
    b2: Scale = 0.999,
    eps: Scale = 1e-8,
    prefilter: Filter | None = None,
    postfilter: Filter | None = None,
    second_moment: Literal["filter", "max", "none"] = "filter",
) -> optax.GradientTransformationExtraArgs:
    """Adam with filters in space: `scale_by_filtered_adam`, then the learning rate.

    Args:
        learning_rate: a number or an optax schedule.
        b1: as for `scale_by_filtered_adam`.
        b2: as for `scale_by_filtered_adam`.
        eps: as for `scale_by_filtered_adam`.
        prefilter: as for `scale_by_filtered_adam`.
        postfilter: as for `scale_by_filtered_adam`.
        second_moment: as for `scale_by_filtered_adam`; with `optax.inject_hyperparams` all three
            are among its static_args.

    Returns:
        An optimiser, whose `update` needs the parameters if there is a filter.

    Raises:
        ValueError: as `scale_by_filtered_adam`.

    Example:
        Only the texture is filtered, and the scale of its edges can be changed on the way:

        >>> import jax.numpy as jnp
        >>> import optax
        >>> import smoothdiff as sd
        >>> @optax.inject_hyperparams
        ... def for_images(learning_rate, sigma_d):
        ...     smooth = sd.filters.cross_bilateral(sigma_d, 5, ndim=2)
        ...     return sd.filtered_adam(learning_rate, b1=0.2, b2=0.36, postfilter=smooth)
        >>> optimiser = optax.multi_transform(
        ...     {"image": for_images(0.1, sigma_d=0.1), "other": optax.adam(0.01)},
        ...     {"texture": "image", "light": "other"},
        ... )
        >>> params = {"texture": jnp.zeros((8, 8, 3)), "light": jnp.ones(3)}
        >>> state = optimiser.init(params)
        >>> grads = {"texture": jnp.ones((8, 8, 3)), "light": jnp.ones(3)}
        >>> updates, state = optimiser.update(grads, state, params)

    Source: Chang et al. 2024, Spatiotemporal Bilateral Gradient Filtering for Inverse Rendering,
    algorithm 2.
    """
    return optax.chain(
        scale_by_filtered_adam(b1, b2, eps, prefilter, postfilter, second_moment),
        optax.scale_by_learning_rate(learning_rate),
    )


def _filtered(filter: Filter | None, tree: PyTree, params: PyTree) -> PyTree:
    if filter is None:
        return tree
    if params is None:
        raise ValueError(
            "filters are guided by the parameters: write `update(grads, state, params)`, "
            "not `update(grads, state)`"
        )
    return jax.tree.map(filter, tree, params)


def _remembers(decay: Scale) -> bool:
    # a hyperparameter that is an array may change, and has no known value under jit
    return not isinstance(decay, int | float) or decay != 0


def _average(decay: Scale, tree: PyTree, moment: PyTree) -> PyTree:
    return jax.tree.map(
        lambda new, old: _scalar(decay, new) * old + (1 - _scalar(decay, new)) * new, tree, moment
    )


def _unbiased(decay: Scale, tree: PyTree, step: Any) -> PyTree:
    return jax.tree.map(lambda x: x / (1 - _scalar(decay, x) ** _scalar(step, x)), tree)


def _scalar(x: Scale, like: Array) -> Array:
    return jnp.asarray(x, like.dtype)
