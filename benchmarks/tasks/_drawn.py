"""Tasks whose parameters are shares of their ranges, and whose loss compares what is drawn."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

from benchmarks._task import Task


def drawn(
    name: str,
    title: str,
    draw: Callable[[Float[Array, " n"]], Float[Array, "..."]],
    reference: np.ndarray,
    support: Any = None,
    meaning: Callable[[Float[Array, " n"]], Shaped[Array, "..."]] | None = None,
    **others: Any,
) -> Task:
    """The task of finding what draws the same as the reference does.

    The domain is [0, 1] for each parameter, and a start is anywhere in it. The loss is the mean
    squared difference.

    Args:
        name: As in `Task`.
        title: As in `Task`.
        draw: From parameters to an array: a picture, or places at some times.
        reference: The parameters that are sought, each in [0, 1].
        support: Which parts of what is drawn a parameter may influence, or None.
        meaning: What parameters mean to a program of switches and counts, or None. The parameter
            error is then the number of entries that differ from the reference's.
        others: Further fields of the task.
    """
    sought = jnp.asarray(reference, jnp.float32)
    target = jax.jit(draw)(sought)

    def residuals(y: Float[Array, " n"]) -> Float[Array, "..."]:
        return draw(y) - target

    def loss(y: Float[Array, " n"]) -> Float[Array, ""]:
        return jnp.mean(residuals(y) ** 2)

    def terms(y: Float[Array, " n"]) -> Float[Array, "..."]:
        return residuals(y) ** 2 / target.size

    def wrong(y: Float[Array, " n"]) -> Int[Array, ""]:
        assert meaning is not None
        return jnp.sum(meaning(y) != meaning(sought))

    return Task(
        name=name,
        title=title,
        loss=loss,
        exact_loss=loss,
        start=lambda seed: jax.random.uniform(jax.random.key(seed), sought.shape),
        reference=sought,
        bounds=(jnp.zeros_like(sought), jnp.ones_like(sought)),
        residuals=residuals,
        terms=None if support is None else terms,
        support=support,
        distance=None if meaning is None else wrong,
        **others,
    )
