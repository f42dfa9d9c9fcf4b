"""The cases of a test: which are quick, and those that a new public class brings by itself."""

import inspect
from collections.abc import Collection, Iterable
from typing import Any

import pytest

import smoothdiff as sd


def quick_of(cases: Iterable[Any], quick: Collection[Any]) -> list[Any]:
    """The cases for `parametrize`; those that are not among the quick ones are slow."""
    return [case if case in quick else pytest.param(case, marks=pytest.mark.slow) for case in cases]


def new_ones(base: type, known: Iterable[type], *arguments: Any) -> dict[str, Any]:
    """An object of each public class of a kind that is not known, by the class's name.

    So who adds a class need not add it to the tests, unless it takes other arguments.
    """
    public = [thing for name in sd.__all__ if inspect.isclass(thing := getattr(sd, name))]
    new = [it for it in public if issubclass(it, base) and not inspect.isabstract(it)]
    return {each.__name__: each(*arguments) for each in new if each not in [*known]}
