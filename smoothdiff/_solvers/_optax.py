"""What is an optax transformation, and what is wrong with one that asks for more than it gets."""

from typing import Any

import optax
from jaxtyping import Array, PyTree


def check_optax(optim: Any, name: str) -> None:
    """Raises TypeError unless it is one."""
    if isinstance(optim, optax.GradientTransformation):
        return
    if isinstance(optim, optax.MultiSteps):
        raise TypeError(f"{name} is a MultiSteps: write {name}.gradient_transformation()")
    raise TypeError(f"{name} must be an optax transformation such as optax.adam(0.1): {optim}")


def updated(
    optim: optax.GradientTransformation,
    grad: PyTree[Array],
    state: PyTree,
    y: PyTree[Array],
    **more: Any,
) -> tuple[PyTree[Array], PyTree]:
    """The updates and the new state; `more` is what else is known of the function.

    Raises:
        TypeError: some part of it takes no more, or asks for the function.
    """
    optim, more = optax.with_extra_args_support(optim), {"grad": grad, **more}
    try:
        return optim.update(grad, state, y, **more)
    except TypeError as error:
        if "required keyword-only argument" in str(error):
            raise TypeError(
                f"the optax transformation asks for more than {', '.join(more)}, as line searches "
                "do for the function itself: use one without, such as optax.adam(0.1) or "
                "optax.lbfgs(0.1, linesearch=None), or a surrogate for the function, "
                "sd.ZeroGrads(sigma, optimizer=optax.lbfgs())"
            ) from error
        if "unexpected keyword argument" in str(error):
            raise TypeError(
                f"the optax transformation, or a part of it, does not take {', '.join(more)}: give "
                "optax.GradientTransformation(part.init, part.update) in place of that part"
            ) from error
        raise
