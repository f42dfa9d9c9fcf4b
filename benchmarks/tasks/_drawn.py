"""What tasks share whose loss compares what parameters draw with what the reference draws."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Shaped
from numpy.typing import ArrayLike

from benchmarks._task import Effort, Problem, Score, Task, entry


def uniform(
    n: int, low: float = 0.0, high: float = 1.0, around: ArrayLike = 0.0
) -> Callable[[int], Float[Array, " n"]]:
    """Starts, seed -> y, anywhere between low and high, or so far from where they are around."""
    away = lambda seed: jax.random.uniform(jax.random.key(seed), (n,), minval=low, maxval=high)
    return lambda seed: jnp.asarray(around) + away(seed)


def drawn(
    full: bool,
    *,
    name: str,
    title: str,
    draw: Callable[[Float[Array, " n"]], Float[Array, "..."]],
    reference: ArrayLike,
    sigma: float,
    effort: tuple[Effort, Effort],
    start: Callable[[int], Float[Array, " n"]] | None = None,
    bounds: tuple[float, float] = (0.0, 1.0),
    support: Callable[[], Any] = lambda: None,
    image: Callable[[Float[Array, " n"]], Float[Array, "height width 3"]] | None = None,
    meaning: Callable[[Float[Array, " n"]], Shaped[Array, "..."]] | None = None,
    optimum: float | None = None,
    notes: str = "",
) -> Task:
    """The task of finding what draws the same as the reference does; others as in `Task`.

    Args:
        draw: From parameters to an array: a picture, or places at some times. The loss is the mean
            squared difference.
        effort: Quick and full.
        start: By default anywhere in the domain.
        bounds: Those of each parameter. By default parameters are shares of their ranges.
        support: Makes that of what is drawn.
        meaning: What parameters mean to a program of switches and counts, or None. The parameter
            error is then the number of entries that differ from the reference's.
    """
    sought, much = jnp.asarray(reference, jnp.float32), effort[full]
    target = jax.jit(draw)(sought)
    low, high = (jnp.full_like(sought, bound) for bound in bounds)

    def wrong(y: Float[Array, " n"]) -> Int[Array, ""]:
        assert meaning is not None
        return jnp.sum(meaning(y) != meaning(sought))

    def residuals(y: Float[Array, " n"]) -> Float[Array, "..."]:
        return draw(y) - target

    return Task(
        name,
        title,
        Problem((low, high), sigma, much.budget, residuals=residuals, support=support()),
        Score(sought, image=image, distance=None if meaning is None else wrong, optimum=optimum),
        start or uniform(sought.size),
        much.seeds,
        notes=notes,
    )


function, program = partial(entry, "function", drawn), partial(entry, "program", drawn)
