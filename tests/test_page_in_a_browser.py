"""The page of the committed results in a headless Chromium, at the widths of a phone and a desk."""

import pytest
from browser import browser, missing

from benchmarks import _study
from benchmarks.studies import report

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(bool(missing()), reason=f"this machine has no {' and no '.join(missing())}"),
]
SIZES = ((400, 800), (1400, 900))
MOST = 4e6  # bytes
ANSWER = "cma-es-few-plateaus-number"
FIRST_SCREEN = f"""
const answer = document.getElementById({ANSWER!r}), box = answer.getBoundingClientRect();
return [box.top, box.bottom, innerHeight, answer.innerText, scrollY];
"""
SHOWN = (
    "return [...document.querySelectorAll('.answer')].filter(a => a.offsetHeight).map(a => a.id)"
)
WIDTHS = "return [document.documentElement.scrollWidth, innerWidth]"
BROKEN = """
document.querySelectorAll('details').forEach(each => { each.open = true; });
document.querySelectorAll('img').forEach(each => { each.loading = 'eager'; });
return Promise.all([...document.images].map(each => each.decode().then(() => null, () => each.alt)))
  .then(found => [found.length, found.filter(each => each !== null)]);
"""


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The page of what is committed, made anew."""
    made = report.write(_study.COMMITTED, tmp_path_factory.mktemp("page"), [])
    assert made is not None
    return made


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    """A browser."""
    with browser(tmp_path_factory.mktemp("profile")) as found:
        yield found


def test_the_page_is_small_enough_to_send(page):
    assert page.stat().st_size < MOST


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize(("width", "height"), SIZES)
def test_the_first_screen_holds_the_answer(opened, page, width, height, dark):
    opened.open(page, width, height, dark)
    top, bottom, inner, text, scrolled = opened.ask(FIRST_SCREEN)
    assert 0 <= top < bottom <= inner == height
    assert scrolled == 0
    assert "NewtonCG against CMA-ES" in text
    assert text.count("×") >= 2  # evaluations and seconds
    assert "Solved: NewtonCG" in text
    assert opened.ask(SHOWN) == [ANSWER]
    assert opened.said() == []


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_nothing_is_wider_than_the_page_and_no_picture_is_broken(opened, page, width, height):
    opened.open(page, width, height)
    count, broken = opened.ask(BROKEN)
    assert count > 300
    assert broken == []
    scrolled, inner = opened.ask(WIDTHS)  # with everything that is folded opened
    assert scrolled <= inner == width
    assert opened.said() == []


def test_a_choice_changes_the_answer_and_can_be_sent_as_a_link(opened, page):
    opened.open(page, 1400, 900)
    for key in ("nelder-mead", "some", "residuals"):
        opened.ask(f"document.querySelector('.chip[data-key=\"{key}\"]').click()")
    chosen = "nelder-mead-some-plateaus-residuals"
    assert opened.ask(SHOWN) == [chosen]
    assert opened.ask("return location.hash") == f"#{chosen}"
    opened.open(page, 1400, 900, at="#fr22-many-smooth-number")
    assert opened.ask(SHOWN) == ["fr22-many-smooth-number"]
    assert opened.ask("return scrollY") == 0  # the questions are above it


def test_without_javascript_links_lead_to_the_answers(opened, page):
    opened.command("Emulation.setScriptExecutionDisabled", {"value": True})
    try:
        opened.open(page, 400, 800)
        assert {each.rpartition("-few")[0] for each in opened.ask(SHOWN)} >= {"cma-es"}
        assert len(opened.ask(SHOWN)) == 12
        opened.open(page, 400, 800, at="#now-mitsuba")
        assert {each.split("-")[0] for each in opened.ask(SHOWN)} == {"mitsuba"}
        assert opened.ask(WIDTHS) == [400, 400]
    finally:
        opened.command("Emulation.setScriptExecutionDisabled", {"value": False})
