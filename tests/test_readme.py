"""What README says to type works: its examples run, its commands and files are there."""

import json
import re
from pathlib import Path

import jax
import numpy as np
import pytest

from benchmarks import __main__ as cli
from benchmarks import _registry

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "benchmarks" / "README.md", ROOT / "CONTRIBUTING.md"]
SAID = r"python -m benchmarks ((?:[^`\n]|\n(?=[^\n]))*)"


@pytest.fixture
def blocks():
    return re.findall(r"```python\n(.*?)```", PAGES[0].read_text(), re.DOTALL)


@pytest.mark.slow
def test_examples_run_one_after_the_other(blocks):
    names = {}
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        for block in blocks:
            exec(block, names)
            for said in re.findall(r"result\.y\)  # close to (\[.*\])", block):
                np.testing.assert_allclose(names["result"].y, json.loads(said), atol=0.1)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_what_a_page_points_to_exists(page):
    text = page.read_text()
    headings = {
        re.sub(r"[^\w -]", "", line.lower()).strip().replace(" ", "-")
        for line in text.splitlines()
        if line.startswith("#")
    }
    for target in re.findall(r"\]\(([^)]+)\)", text):
        if target.startswith("#"):
            assert target[1:] in headings
        elif "://" not in target:
            assert (page.parent / target.partition("#")[0]).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_are_understood(page):
    for said in re.findall(SAID, page.read_text()):
        # any task stands for all where a page says TASK
        options = cli.parser().parse_args(re.sub(r"\bTASK\b", "led", said).split())
        named = getattr(options, "methods", None)
        assert not named or set(named.split(",")) <= set(_registry.methods()), said
