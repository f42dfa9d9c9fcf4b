"""The pages of the documentation, and the Python in them. No tests here."""

import re
import textwrap
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
DOCS = sorted((ROOT / "docs").rglob("*.md"))

_BLOCK = re.compile(
    r"(?:^ *<!-- not run: (?P<why>.*?) -->\n)?(?P<indent>^ *)```python\n(?P<code>.*?)^ *```",
    re.DOTALL | re.MULTILINE,
)


class Block(NamedTuple):
    """Code in a page, and why it is not run, if it is not."""

    page: Path
    line: int
    code: str
    why_not: str | None

    def __str__(self):
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def blocks(page: Path) -> list[Block]:
    """The blocks of Python in a page."""
    text = page.read_text()
    return [
        Block(page, text[: m.start("code")].count("\n"), textwrap.dedent(m["code"]), m["why"])
        for m in _BLOCK.finditer(text)
    ]


def sentences(page: Path) -> list[str]:
    """The sentences of a page, without code, tables, headings and equations."""
    text = re.sub(r"```.*?```|\$\$.*?\$\$", "", page.read_text(), flags=re.DOTALL)
    prose = re.sub(r"^(\||#|    |---|<).*$", "", text, flags=re.MULTILINE)
    paragraphs = re.split(r"\n\s*\n|^[-*] |^\d\. ", prose, flags=re.MULTILINE)
    found = [s for part in paragraphs for s in re.split(r"(?<=[.!?:])\s+", part.strip())]
    return [s for s in found if len(s.split()) > 2]
