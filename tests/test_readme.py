"""What the pages say to type works: examples run, commands and files are there, names exist."""

import ast
import inspect
import pkgutil
import re
import statistics
from pathlib import Path

import pages
import pasted
import pytest
from pages import DOCS, README, ROOT

import smoothdiff as sd
from benchmarks import __main__ as cli
from benchmarks import _registry
from benchmarks.studies import profiles
from benchmarks.studies.zerograds import ablations
from smoothdiff.renderers import mitsuba

ELSEWHERE = [ROOT / "benchmarks" / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"]
PAGES = [README, *ELSEWHERE, *DOCS]
CODE = [block for page in PAGES for block in pages.blocks(page)]
SAID = r"python -m benchmarks ((?:[^`\n]|\n(?=[^\n]))*)"
# pages that show their result in a picture
START = "import matplotlib; matplotlib.use('agg')\n"


def named(page):
    return str(page.relative_to(ROOT))


def run(block, folder, context):
    """Runs a block as its reader would: pasted into a file in an empty folder."""
    code = block.code + "\n" if block.page == README else START + block.code
    (folder / pasted.CODE).write_text(code)
    # most of the time is compiling
    quick = {"jax_disable_most_optimizations": True, "jax_traceback_in_locations_limit": 0}
    process = context.Process(target=pasted.run, args=(folder, quick))
    process.start()
    process.join()
    errors = (folder / pasted.ERRORS).read_text()
    missing = re.search(r"ModuleNotFoundError: No module named '(\w+)", errors)
    if missing and missing[1] not in ("smoothdiff", "benchmarks"):
        pytest.skip(f"{missing[1]} is not installed")
    assert process.exitcode == 0, errors
    return (folder / pasted.OUT).read_text()


@pytest.mark.slow
@pytest.mark.parametrize("block", [b for b in CODE if not b.why_not], ids=str)
def test_examples_run_alone(block, tmp_path, context):
    printed = run(block, tmp_path, context)
    for said in re.findall(r"print\(.*\)  # close to \[(.*)\]", block.code):
        shown = re.search(r"\[(.*?)\]", printed)
        assert shown, printed
        want, seen = (
            [float(x) for x in re.split(r"[,\s]+", part.strip())] for part in (said, shown[1])
        )
        assert seen == pytest.approx(want, abs=0.1)


@pytest.mark.parametrize("block", CODE, ids=str)
def test_examples_use_names_that_exist(block):
    tree = ast.parse(block.code)
    assert "benchmarks" not in block.code, "pip installs no benchmarks"
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            module = {"sd": sd, "mitsuba": mitsuba}.get(node.value.id)
            assert module is None or hasattr(module, node.attr), ast.unparse(node)
        if isinstance(node, ast.Call):
            check_arguments(node)


def check_arguments(call):
    """Arguments that are named exist, where a function of ours is called by its name."""
    name = ast.unparse(call.func)
    thing = getattr(sd, name.removeprefix("sd."), None) if name.startswith("sd.") else None
    if thing is None or inspect.ismodule(thing):
        return
    taken = inspect.signature(thing).parameters
    if any(p.kind is p.VAR_KEYWORD for p in taken.values()):
        return
    assert {k.arg for k in call.keywords if k.arg} <= set(taken), ast.unparse(call)


def test_the_version_is_the_same_everywhere():
    said = {
        "pyproject.toml": r'^version = "(.*)"$',
        "CITATION.cff": r"^version: (.*)$",
        "CHANGELOG.md": r"^## \[(\d.*?)\] - \d{4}-\d\d-\d\d$",
        "docs/citing.md": r"^  version = \{(.*)\},$",
    }
    for name, pattern in said.items():
        found = re.search(pattern, (ROOT / name).read_text(), re.MULTILINE)
        assert found, name
        assert found[1] == sd.__version__, name


def test_readme_is_short():
    text = README.read_text()
    assert len(text.split()) <= 700
    assert max(len(line) for line in text.splitlines()) <= 100


def test_sentences_are_short():
    lengths = [len(s.split()) for page in [README, *DOCS] for s in pages.sentences(page)]
    assert len(lengths) > 200
    assert statistics.median(lengths) < 18


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_what_a_page_points_to_exists(page):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if "://" in target:
            continue
        path, _, anchor = target.partition("#")
        # the site has the repository's files beside the pages of docs/
        places = [
            page.parent / path,
            *(folder / path for folder in (ROOT, ROOT / "docs", ROOT / "docs" / "x")),
        ]
        there = page if not path else next((p for p in places if p.resolve().exists()), None)
        if there is None and Path(path).parent.name == "notebooks":
            there = (ROOT / "notebooks" / Path(path).name).with_suffix(".ipynb")
        assert there, target
        assert there.exists(), target
        if anchor and not anchor.startswith("smoothdiff."):
            assert anchor in headings(there), target


def headings(page):
    return {
        re.sub(r"[^\w -]", "", line.lower()).strip().replace(" ", "-")
        for line in page.read_text().splitlines()
        if line.startswith("#")
    }


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_commands_are_understood(page):
    for said in re.findall(SAID, page.read_text()):
        # a shell joins lines; any task stands for all where a page says TASK
        said = said.replace("\\\n", " ")
        options = cli.parser().parse_args(re.sub(r"\bTASK\b", "led", said).split())
        methods = getattr(options, "methods", None)
        known = {*_registry.methods(), *profiles.METHODS, *ablations.methods()}
        assert not methods or set(methods.split(",")) <= known, said


def test_the_api_pages_have_every_public_name():
    text = "\n".join(page.read_text() for page in (ROOT / "docs" / "api").glob("*.md"))
    shown = set(re.findall(r"^::: smoothdiff\.([\w.]+)", text, re.MULTILINE))
    # the site adds those that a page does not name
    for base in re.findall(r"^::: others of ([\w.]+)$", text, re.MULTILINE):
        public = {name: getattr(sd, name) for name in sd.__all__}
        kind = pkgutil.resolve_name(base)
        shown |= {n for n, it in public.items() if inspect.isclass(it) and issubclass(it, kind)}
    modules = {name for name in sd.__all__ if inspect.ismodule(getattr(sd, name))}
    want = set(sd.__all__) - modules
    for module in [*(getattr(sd, name) for name in modules), mitsuba]:
        local = module.__name__.removeprefix("smoothdiff.")
        names = getattr(module, "__all__", None) or [
            name
            for name, thing in vars(module).items()
            if inspect.isfunction(thing) and thing.__module__ == module.__name__ and name[0] != "_"
        ]
        want |= {f"{local}.{name}" for name in names}
    assert shown == want
