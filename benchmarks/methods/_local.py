"""A task with local support as a function of one vector: its terms, and which of them to blame."""

from collections.abc import Callable
from typing import NamedTuple

import jax
from jax.flatten_util import ravel_pytree

from benchmarks._task import NotAble, Task
from benchmarks.methods._flat import Flat


class Local(NamedTuple):
    """What methods with local support need of a task.

    Attributes:
        flat: The task in flat vectors.
        terms: vector -> terms, at the nearest point within the bounds.
        support: vector -> an array like the terms: for each, the sum of what may influence it.
    """

    flat: Flat
    terms: Callable[[jax.Array], jax.Array]
    support: Callable[[jax.Array], jax.Array]


def local(task: Task) -> Local:
    """Raises NotAble where the loss is not a sum of terms with a local support."""
    terms, support = task.terms, task.support
    if terms is None or support is None:
        raise NotAble("needs a loss that is a sum of terms with a local support")
    flat, unravel = Flat(task), ravel_pytree(task.reference)[1]
    return Local(flat, lambda x: terms(flat.tree(x)), lambda x: support(unravel(x)))
