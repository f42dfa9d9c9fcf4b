"""Functions that draw random numbers: the same ones within a step, fresh ones in the next.

Such a function takes a key. For a solver that is the second part of its args, and the option
"takes_key" says so. From this key come those of the steps, and of the rounds of the last judgement.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
from jaxtyping import Array, Int, PyTree

from smoothdiff._params import as_key

# what keys are made for: the numbers of no step
_STEP, _ROUND = 2**31 - 2, 2**31 - 3


class _Keyed(eqx.Module):
    """A function of y, args and a key as a solver calls it; equal to another one of the same."""

    fun: Callable[[PyTree, PyTree, Array], Any]

    def __call__(self, y: PyTree, args: tuple[PyTree, Array]) -> Any:
        """What the function returns, with args and key in one."""
        return self.fun(y, *args)


def keyed(
    fun: Callable[[PyTree, PyTree, Array], Any], args: PyTree, key: Any
) -> tuple[Callable[[PyTree, PyTree], Any], tuple[PyTree, Array]]:
    """The function and its args for a solver."""
    return _Keyed(fun), (args, as_key(key))


def takes_key(options: dict[str, Any]) -> bool:
    """Whether the function takes a key."""
    return bool(options.get("takes_key", False))


def in_step(args: PyTree, options: dict[str, Any], step: int | Int[Array, ""]) -> PyTree:
    """The arguments of the function in a step, or in all that share these random numbers."""
    return _fresh(args, options, _STEP, step)


def in_round(args: PyTree, options: dict[str, Any], number: int | Int[Array, ""]) -> PyTree:
    """The arguments of the function in a round of the last judgement."""
    return _fresh(args, options, _ROUND, number)


def _fresh(args: PyTree, options: dict[str, Any], purpose: int, count: Any) -> PyTree:
    if not takes_key(options):
        return args
    if not isinstance(args, tuple) or len(args) != 2:
        raise ValueError(
            f"args is {type(args).__name__}, but with the option takes_key it is a pair: write "
            "args=(args, key)"
        )
    args, key = args
    return args, jax.random.fold_in(jax.random.fold_in(key, purpose), count)
