"""A task with local support as a function of one vector: its terms, and which of them to blame."""

from collections.abc import Callable
from typing import NamedTuple

import jax
from jax.flatten_util import ravel_pytree

import smoothdiff as sd
from benchmarks._task import NotAble, Task
from benchmarks.methods._flat import Flat
from smoothdiff._support import AbstractSupport, as_support


class Local(NamedTuple):
    """What methods with local support need of a task.

    Attributes:
        flat: The task in flat vectors.
        terms: vector -> terms, at the nearest point within the bounds.
        support: Of vectors; it may depend on where they are, so ask for it `at` one.
    """

    flat: Flat
    terms: Callable[[jax.Array], jax.Array]
    support: AbstractSupport


def local(task: Task) -> Local:
    """Raises NotAble where the loss is not a sum of terms with a local support."""
    terms, support = task.terms, as_support(task.support)
    if terms is None or support is None:
        raise NotAble("needs a loss that is a sum of terms with a local support")
    flat, unravel = Flat(task), ravel_pytree(task.reference)[1]
    around = lambda x: lambda params: support.at(unravel(x))(unravel(params))
    return Local(flat, lambda x: terms(flat.tree(x)), sd.moving_support(around))
