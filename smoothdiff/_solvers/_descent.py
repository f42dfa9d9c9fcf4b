"""Updates of the parameters on a function that costs nothing: the surrogate of ZeroGrads."""

from collections.abc import Callable

import jax
import optax
from jaxtyping import Array, Float, PyTree

from smoothdiff._params import Params
from smoothdiff._solvers._base import project, promotion
from smoothdiff._solvers._optax import updated

# the default rate, in units of sigma
_RATE = 0.05


def descended(
    height: Callable[[PyTree], Float[Array, ""]],
    y: PyTree[Array],
    opt_state: PyTree,
    optim: optax.GradientTransformation,
    bounds: tuple[PyTree, PyTree] | None,
    *,
    length: int,
) -> tuple[PyTree[Array], PyTree]:
    """Some updates by the gradient of `height`, each projected to the bounds."""

    def update(carry, _):
        y, opt_state = carry
        value, grad = jax.value_and_grad(height)(y)
        with promotion():
            updates, opt_state = updated(optim, grad, opt_state, y, value=value, value_fn=height)
            return (project(optax.apply_updates(y, updates), bounds), opt_state), None

    return jax.lax.scan(update, (y, opt_state), length=length)[0]


def as_optimizer(
    optim: optax.GradientTransformation | None, params: Params
) -> optax.GradientTransformation:
    """The user's transformation; without one Adam, in units of each parameter's sigma."""
    if optim is not None:
        return optim
    adam, layout, sigma = optax.adam(_RATE), params.layout, params.sigma

    def update(updates, state, params=None):
        updates, state = adam.update(updates, state, params)
        return layout.tree(sigma * layout.vector(jax.tree.leaves(updates))), state

    return optax.GradientTransformation(adam.init, update)
