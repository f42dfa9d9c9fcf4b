"""The stages of a search: what is evaluated next, and how many at once."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
from jaxtyping import Array, Int

# what is evaluated next: the first points, a step of the local model, samples around a center,
# points further and further away, points anywhere within the bounds, or along a parameter
FIRST, TRUST, WIDE, PILOT, LOOK, SCAN = 0, 1, 2, 3, 4, 5


class Sizes(NamedTuple):
    """Evaluations a step, and samples of a first wide round and of a later one.

    After `patience` evaluations in a row that hardly lowered the function a search may end. The run
    makes so many evaluations `at_once`; a `Search` may be asked for other numbers of points.
    """

    step: int
    first: int
    later: int
    patience: int
    at_once: int = 1

    @staticmethod
    def of(at_once: int | None, first: int, later: int, patience: int) -> "Sizes":
        """For so many evaluations at once, or one; rounds take as many steps as they need."""
        step = at_once or 1
        first, later = (-(-count // step) * step for count in (first, later))
        return Sizes(step, first, later, patience, step)


def by_stage(
    stage: Int[Array, ""], known: int | None, branches: Sequence[Callable[[], Any]]
) -> Any:
    """What one of the branches gives: that of the stage, or of the stage that is `known`."""
    return jax.lax.switch(stage, branches) if known is None else branches[known]()
