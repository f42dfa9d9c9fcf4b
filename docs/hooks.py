"""What the site adds to mkdocs: MathML, notebooks, entries of the API, and what pages link to."""

import html
import inspect
import pkgutil
import posixpath
import re
from pathlib import Path

from math_core import LatexToMathML
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from nbconvert import MarkdownExporter
from nbconvert.preprocessors import CoalesceStreamsPreprocessor

import smoothdiff as sd

ROOT = Path(__file__).parents[1]
NOTEBOOKS = ROOT / "notebooks"
# where these say README they mean, on the site, the page with the same content
PAGES = {"benchmarks/README.md": "../evidence.md", "CONTRIBUTING.md": "", "CHANGELOG.md": ""}
ENTRY = re.compile(r"^::: smoothdiff\.(\w+)", re.MULTILINE)
OTHERS = re.compile(r"^::: others of ([\w.]+)$", re.MULTILINE)
LINK = re.compile(r"\]\(([^)#\s]+)")
EQUATION = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages that lie elsewhere in the repository, and all that any page links to."""
    for name, readme in PAGES.items():
        text = (ROOT / name).read_text()
        # on the site pages lie beside these, not in docs/
        text = text.replace("](../README.md)", f"]({readme})")
        text = re.sub(r"\]\(((?:\.\./)*)docs/", r"](\1", text)
        files.append(made(config, name, text))
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        for name, content in as_pages(path):
            files.append(made(config, name, content))
    for page in list(files.documentation_pages()):
        if page.generated_by is None:
            page.content_string = as_on_site(page.content_string, page.src_uri)
        for target in LINK.findall(page.content_string):
            name = posixpath.normpath(posixpath.join(posixpath.dirname(page.src_uri), target))
            lies = ROOT / name
            if "://" not in target and files.get_file_from_path(name) is None and lies.is_file():
                files.append(File.generated(config, name, abs_src_path=str(lies)))
    return files


def as_on_site(text: str, name: str) -> str:
    """Links out of docs/ as they are on the site, where pages lie beside those of other folders."""
    up = "../" * (name.count("/") + 1)
    text = text.replace(f"]({up}", f"]({up.removesuffix('../')}")
    return re.sub(r"(\]\((?:\.\./)*notebooks/[\w-]+)\.ipynb", r"\1.md", text)


def made(config: MkDocsConfig, name: str, content: str | bytes) -> File:
    """A file of the site that is no file of the repository."""
    return File.generated(config, name, content=content)


def as_pages(path: Path) -> list[tuple[str, str | bytes]]:
    """A notebook as a page, and the pictures in it."""
    # what a cell printed is one block
    exporter = MarkdownExporter(preprocessors=[CoalesceStreamsPreprocessor])
    text, resources = exporter.from_filename(str(path))
    text = re.sub(r"\]\(([\w-]+)\.ipynb\)", r"](\1.md)", text)
    folder = f"notebooks/{path.stem}"
    for name in resources["outputs"]:
        text = text.replace(f"]({name})", f"]({path.stem}/{name})")
    pictures = [(f"{folder}/{name}", data) for name, data in resources["outputs"].items()]
    return [(f"{folder}.md", text), *pictures]


def on_page_markdown(markdown: str, **_: object) -> str:
    """`::: others of CLASS` stands for all public subclasses that the page does not name."""
    named = ENTRY.findall(markdown)

    def entries(match: re.Match[str]) -> str:
        base = pkgutil.resolve_name(match[1])
        public = {name: getattr(sd, name) for name in sd.__all__ if name not in named}
        found = [n for n, it in public.items() if inspect.isclass(it) and issubclass(it, base)]
        return "\n\n".join(f"::: smoothdiff.{n}\n    options:\n      members: false" for n in found)

    return OTHERS.sub(entries, markdown)


def on_page_content(content: str, **_: object) -> str:
    """Equations in LaTeX become MathML, which browsers draw by themselves."""
    convert = LatexToMathML().convert_with_local_state

    def as_mathml(match: re.Match[str]) -> str:
        tag, latex = match[1], html.unescape(match[2])
        return f'<{tag} class="arithmatex">{convert(latex, displaystyle=tag == "div")}</{tag}>'

    return EQUATION.sub(as_mathml, content)
