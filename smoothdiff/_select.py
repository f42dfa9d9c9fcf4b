"""The choice of a surrogate by what it says of points that it has not seen."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Key

from smoothdiff._numbers import floating


class Selection(NamedTuple):
    """What `select` chose.

    Attributes:
        surrogate: the candidate, as `ZeroGrads` takes it.
        errors: for each candidate, what its fit leaves of the held-out values' variance.
        stderrs: the standard errors of those.

    Example:
        >>> import jax
        >>> from smoothdiff import surrogates
        >>> u = jax.random.normal(jax.random.key(0), (100, 2))
        >>> chosen = surrogates.select(
        ...     [surrogates.Quadratic], u, u[:, 0], key=jax.random.key(1), steps=50
        ... )
        >>> chosen.surrogate.__name__, chosen.errors.shape
        ('Quadratic', (1,))

    Source: ZeroGrads (Fischer and Ritschel) leaves the choice to future work.
    """

    surrogate: Callable[..., Any]
    errors: np.ndarray
    stderrs: np.ndarray


def select(
    candidates: Sequence[Callable[..., Any]],
    u: Float[Array, "N n"],
    values: Float[Array, " M"],
    *,
    key: Key[Array, ""],
    held_out: float = 0.25,
    steps: int = 500,
    optimizer: optax.GradientTransformation = optax.adam(1e-2),  # noqa: B008
) -> Selection:
    r"""The simplest surrogate whose error on held-out points is no worse than that of the best.

    Each candidate is fitted to the same share of the points, and judged on the others by

    $$ \text{error} = \frac{\sum_i (h(u_i) - v_i)^2}{\sum_i (v_i - \bar v)^2}. $$

    Of those within one standard error of the lowest, the first is chosen: sort them from simple to
    complex. Runs on the host, since what it returns is a function.

    Args:
        candidates: each called as `candidate(size, key=key)`, like `ZeroGrads`' `surrogate`.
        u: points in units of sigma, as a surrogate sees them.
        values: the function at the points.
        key: draws which points are held out, and the weights.
        held_out: the share of the points that is held out.
        steps: updates of each fit, each on all points that are not held out.
        optimizer: an optax transformation for the weights.

    Returns:
        A `Selection`: the candidate, and the errors of all.

    Raises:
        ValueError: no candidates; fewer than two points to fit or to judge by; points and values
            that differ in number; points that are no rows; what is not finite.
        TypeError: complex numbers.

    Example:
        >>> import functools, jax, jax.numpy as jnp
        >>> from smoothdiff import surrogates
        >>> u = jax.random.normal(jax.random.key(0), (200, 2))
        >>> widths = [functools.partial(surrogates.MLP, width=w, depth=1) for w in (2, 64)]
        >>> chosen = surrogates.select(widths, u, jnp.sin(3 * u[:, 0]), key=jax.random.key(1))
        >>> chosen.surrogate.keywords["width"]
        64

    Source: ZeroGrads (Fischer and Ritschel) leaves the choice of a surrogate's complexity to future
    work; the rule of one standard error is that of Breiman et al. 1984.
    """
    if np.ndim(u) != 2 or np.ndim(values) != 1:
        raise ValueError(
            f"u must have a row for each point, and values a number, not the shapes {np.shape(u)} "
            f"and {np.shape(values)}"
        )
    u, values = floating(u), floating(values)
    number = round(held_out * len(u))
    if not candidates:
        raise ValueError("select needs at least one candidate, such as smoothdiff.surrogates.MLP")
    if len(u) != len(values):
        raise ValueError(f"{len(u)} points and {len(values)} values: give one value for each point")
    if min(number, len(u) - number) < 2:
        raise ValueError(
            f"held_out={held_out} of {len(u)} points leaves {len(u) - number} to fit and {number} "
            "to judge by: give more points"
        )
    if not (jnp.all(jnp.isfinite(values)) and jnp.all(jnp.isfinite(u))):
        raise ValueError("points and values must be finite: leave out where the function failed")
    order = jax.random.permutation(jax.random.fold_in(key, len(candidates)), len(u))
    seen, unseen = order[number:], order[:number]
    level, spread = jnp.mean(values[seen]), jnp.std(values[seen])
    goal = ((values - level) / jnp.where(spread > 0, spread, 1)).astype(u.dtype)

    @eqx.filter_jit
    def squares(surrogate: Any) -> Array:
        """The squared errors on the held-out points, after the fit."""
        weights, rest = eqx.partition(surrogate, eqx.is_inexact_array)
        weights = jax.tree.map(lambda w: w.astype(u.dtype), weights)
        left = lambda weights, at: jax.vmap(eqx.combine(weights, rest))(u[at]) - goal[at]
        optim = optax.with_extra_args_support(optimizer)

        def update(carry, _):
            weights, state = carry
            value, grad = jax.value_and_grad(lambda w: jnp.mean(left(w, seen) ** 2))(weights)
            # optax mixes dtypes: Adam raises a float to an integer
            with jax.numpy_dtype_promotion("standard"):
                updates, state = optim.update(grad, state, weights, value=value, grad=grad)
                return (optax.apply_updates(weights, updates), state), None

        (weights, _), _ = jax.lax.scan(update, (weights, optim.init(weights)), length=steps)
        return left(weights, unseen) ** 2

    keys = jax.random.split(key, len(candidates))
    made = [make(u.shape[1], key=k) for make, k in zip(candidates, keys, strict=True)]
    rows = np.stack([np.asarray(squares(surrogate), float) for surrogate in made])
    variance = max(float(jnp.var(goal[unseen])), np.finfo(goal.dtype).tiny)
    errors, stderrs = rows.mean(1) / variance, rows.std(1, ddof=1) / np.sqrt(number) / variance
    best = np.nanargmin(errors)
    first = int(np.argmax(errors <= errors[best] + stderrs[best]))
    return Selection(candidates[first], errors, stderrs)
