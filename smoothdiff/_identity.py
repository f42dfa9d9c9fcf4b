"""What makes a problem the one that it is, kept beside what was computed of it."""

import re
from collections.abc import Iterable, Mapping
from typing import Any

from smoothdiff._digest import parts


class Identity:
    """Digests of the parts of some values; None of a part that is known to change by itself."""

    def __init__(self, **values: Any):
        self._values = values
        self._arrays: dict = {}
        self.parts: dict[str, str | None] = {**parts(values, self._arrays)}

    def differing(self, kept: Mapping[str, str | None]) -> set[str]:
        """The names of the parts that are not as they are in others, which were kept."""
        return _differing(self.parts, kept)

    def changed(self) -> set[str]:
        """The names of those that have changed since."""
        return _differing(self.parts, parts(self._values, self._arrays))

    def settle(self) -> set[str]:
        """The names of those that have changed since, while all went on: they do not count."""
        changed = self.changed()
        self.parts |= dict.fromkeys(changed)
        return changed


def can_change(part: str) -> bool:
    """Whether it is something that can change in place, such as a list."""
    return ":" in part


def listed(names: Iterable[str]) -> str:
    """Names of parts as an error shows them."""
    shown = sorted({".".join(filter(None, re.split(r"[.:]", name))) for name in names})
    return ", ".join([*shown[:6], *([f"{len(shown) - 6} more"] if len(shown) > 6 else [])])


def _differing(one: Mapping[str, str | None], other: Mapping[str, str | None]) -> set[str]:
    ignored = {name for parts in (one, other) for name, part in parts.items() if part is None}
    return {name for name, _ in one.items() ^ other.items()} - ignored
