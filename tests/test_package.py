"""What is published works: wheel and sdist, in an empty environment, with README's blocks."""

import subprocess
import sys
import tarfile
import zipfile

import pages
import pytest
from pages import README, ROOT

pytestmark = pytest.mark.slow


def run(*command, **options):
    return subprocess.run(
        [str(part) for part in command], capture_output=True, text=True, **options
    )


@pytest.fixture(scope="module")
def reachable(tmp_path_factory):
    """Skips where no package can be installed from anywhere."""
    pytest.importorskip("build")
    folder = tmp_path_factory.mktemp("reach")
    tried = run(sys.executable, "-m", "pip", "download", "--no-deps", "hatchling", "-d", folder)
    if tried.returncode:
        pytest.skip("no package registry can be reached")


@pytest.fixture(scope="module")
def built(reachable, tmp_path_factory):
    folder = tmp_path_factory.mktemp("dist")
    made = run(sys.executable, "-m", "build", "--outdir", folder, ROOT)
    assert made.returncode == 0, made.stdout + made.stderr
    (wheel,), (sdist,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    return wheel, sdist


def test_metadata_are_right(built):
    pytest.importorskip("twine")
    checked = run(sys.executable, "-m", "twine", "check", "--strict", *built)
    assert checked.returncode == 0, checked.stdout + checked.stderr


def test_a_wheel_holds_the_library_alone(built):
    names = zipfile.ZipFile(built[0]).namelist()
    assert {name.split("/")[0].split("-")[0] for name in names} == {"smoothdiff"}
    assert "smoothdiff/py.typed" in names


def test_an_sdist_holds_the_tests_and_pages(built):
    with tarfile.open(built[1]) as archive:
        names = archive.getnames()
    inside = {name.partition("/")[2] for name in names}
    assert {"tests/test_package.py", "docs/index.md", "mkdocs.yml", "CITATION.cff"} <= inside


@pytest.fixture(scope="module")
def empty(built, tmp_path_factory):
    """The interpreter of an environment with nothing but the wheel and Mitsuba."""
    folder = tmp_path_factory.mktemp("venv")
    assert run(sys.executable, "-m", "venv", folder).returncode == 0
    python = folder / "bin" / "python"
    installed = run(python, "-m", "pip", "install", f"{built[0]}[mitsuba]")
    assert installed.returncode == 0, installed.stderr
    return python


@pytest.mark.parametrize("block", pages.blocks(README), ids=str)
def test_readme_works_after_a_plain_install(block, empty, tmp_path, as_users):
    (tmp_path / "pasted.py").write_text(block.code)
    # -I: nothing but what is installed there can be imported
    ran = run(empty, "-I", "pasted.py", cwd=tmp_path, env=as_users)
    assert ran.returncode == 0, ran.stderr
