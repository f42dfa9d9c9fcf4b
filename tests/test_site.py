"""The site builds without a warning, needs no other host, and shows all equations."""

import os
import re
import subprocess
import sys
from html.parser import HTMLParser

import pytest
from pages import ROOT

pytestmark = pytest.mark.slow
# to subclass, to catch or to read; the reader makes none
NOT_CALLED = {"AbstractBaseline", "AbstractSampler", "BlackBoxError", "Options"}


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    pytest.importorskip("mkdocs")
    folder = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", folder]
    quiet = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    built = subprocess.run(build, cwd=ROOT, env=quiet, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    assert "WARNING" not in built.stderr
    return folder


class Loaded(HTMLParser):
    """What a browser fetches to show a page."""

    def __init__(self):
        super().__init__()
        self.addresses = []

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        if tag in ("script", "img", "iframe"):
            self.addresses.append(attributes.get("src") or "")
        if tag == "link" and attributes.get("rel") in ("stylesheet", "preconnect", "preload"):
            self.addresses.append(attributes.get("href") or "")


def test_pages_need_no_other_host(site):
    for page in site.rglob("*.html"):
        loaded = Loaded()
        loaded.feed(page.read_text())
        assert not [a for a in loaded.addresses if a.startswith(("http:", "https:", "//"))], page


def test_no_page_is_there_twice(site):
    assert not (site / "docs").exists()


def test_all_equations_are_drawn(site):
    drawn = 0
    for page in site.rglob("*.html"):
        text = page.read_text()
        drawn += text.count("<math")
        assert not re.search(r'class="arithmatex">\s*\\', text), page
    assert drawn > 50


def test_each_public_class_and_function_has_a_signature(site):
    for page in (site / "api").glob("*.html"):
        if page.stem == "index":
            continue
        text = page.read_text()
        names = re.findall(r'<h2 id="smoothdiff\.([\w.]+)"', text)
        assert names
        for name in names:
            if name in NOT_CALLED:
                continue
            assert re.search(rf'<span class="nf">{name.split(".")[-1]}</span>', text), name
