"""An optax transformation that takes Newton steps on a function that is cheap: a surrogate."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from smoothdiff._params import is_concrete
from smoothdiff._solvers._trust_region import truncated_cg


def newton_step(radius: PyTree) -> optax.GradientTransformationExtraArgs:
    r"""Steps to the minimum of the quadratic model of `value_fn` within a radius.

    $$ d = \arg\min_{|d / r| \le 1} \; g \cdot d + \tfrac12 \, d \cdot H d $$

    Truncated conjugate gradients with products $H v$ by AD, so there is no array of n x n numbers,
    and an indefinite H does no harm. For the `optimizer` of `ZeroGrads`, where the products are
    those of the surrogate and cost no evaluation. A surrogate of leaky ReLUs has no curvature: take
    `surrogates.MLP` with its default activation, or `surrogates.Quadratic`.

    Args:
        radius: the longest step, in the units of the parameters: a number or a pytree like the
            parameters. For `ZeroGrads` 10 % of its sigma is a good start.

    Returns:
        A transformation whose `update` needs `params` and `value_fn`; it has no state.

    Raises:
        ValueError: a radius that is not positive; `update` without `params` or `value_fn`.

    Example:
        >>> import jax, jax.numpy as jnp, optax, smoothdiff as sd
        >>> bowl = lambda y: jnp.sum(jnp.array([1.0, 100.0]) * (y - 1) ** 2)
        >>> optim, y = sd.newton_step(radius=5.0), jnp.zeros(2)
        >>> updates, _ = optim.update(jax.grad(bowl)(y), optim.init(y), y, value_fn=bowl)
        >>> print(optax.apply_updates(y, updates).round(3))
        [1. 1.]

    Source: Steihaug 1983; Toint 1981. Second derivatives of the surrogate are named, and not used,
    in ZeroGrads (Fischer and Ritschel).
    """
    if any(is_concrete(r) and not np.all(np.asarray(r) > 0) for r in jax.tree.leaves(radius)):
        raise ValueError(f"radius must be positive: {radius}")

    def init(params: PyTree) -> optax.EmptyState:
        del params
        return optax.EmptyState()

    def update(
        updates: PyTree,
        state: optax.OptState,
        params: optax.Params | None = None,
        *,
        value_fn: Callable[[PyTree], Float[Array, ""]] | None = None,
        **_,
    ) -> tuple[PyTree, optax.OptState]:
        if params is None or value_fn is None:
            raise ValueError(
                "newton_step needs the parameters and the function: call "
                "update(grad, state, params, value_fn=...)"
            )
        flat, tree = ravel_pytree(params)
        widths = jax.tree.map(
            lambda r, p: jnp.broadcast_to(jnp.asarray(r, p.dtype), p.shape),
            jax.tree.broadcast(radius, params),
            params,
        )
        unit = ravel_pytree(widths)[0]
        unit = jnp.where(unit > 0, unit, jnp.nan)  # one that is traced could not be checked
        # the step in units of the radius, so that the region is a ball
        slope = jax.grad(lambda d: value_fn(tree(flat + unit * d)))
        _, curvature = jax.linearize(slope, jnp.zeros_like(flat))
        step = truncated_cg(curvature, unit * ravel_pytree(updates)[0], jnp.ones((), flat.dtype))
        return tree(unit * step), state

    return optax.GradientTransformationExtraArgs(init, update)
