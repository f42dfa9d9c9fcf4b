"""Which cases of a test are quick, and which are left to `pytest -m slow`."""

from collections.abc import Collection, Iterable
from typing import Any

import pytest


def quick_of(cases: Iterable[Any], quick: Collection[Any]) -> list[Any]:
    """The cases for `parametrize`; those that are not among the quick ones are slow."""
    return [case if case in quick else pytest.param(case, marks=pytest.mark.slow) for case in cases]
