"""The report of the scenes: which method is ours, ratios, goals, and the page."""

from html.parser import HTMLParser

import numpy as np
import pytest
from stripes import REFERENCE, SIDE, TITLE, build, registered

from benchmarks import __main__ as cli
from benchmarks import _atlas, _registry, _study
from benchmarks._style import looks
from benchmarks._summary import of_runs
from benchmarks._task import Method
from benchmarks.studies.report import _tables
from benchmarks.studies.report._scene import FEW, RULE, Scene

MACHINE = {"cpu": "a <CPU>", "cores": 2, "python": "3.11", "versions": {"jax": "1"}}
ABOUT = {"setting": "quick", "command": "python -m benchmarks run all", "machine": MACHINE}


def run_of(seed, factor, evaluations):
    """A run whose errors fall by `factor` a step of so many evaluations, which take 0.1 s each."""
    errors = factor ** -np.arange(6.0)
    return {
        "seed": seed,
        "evaluations": evaluations * np.arange(6),
        "seconds": 0.1 * evaluations * np.arange(6),
        "image_error": errors,
        "parameter_error": errors,
        "distance": errors[-1],
        "found": np.asarray(REFERENCE),
        "warm_up_seconds": 1.0,
    }


def of_scene(found, dimensions=2):
    """The results of a scene: method -> evaluations of a step, or a reason."""
    return {
        "title": TITLE,
        "notes": "few <pixels>",
        "budget": {"evaluations": 60, "seconds": 60},
        "sigma": 0.3,
        "dimensions": dimensions,
        "methods": {
            name: {"title": name.title()}
            | (
                {"not_able": took}
                if isinstance(took, str)
                else of_runs([run_of(seed, 10, took) for seed in range(2)])
            )
            for name, took in found.items()
        },
    }


def scene(name="shadow", dimensions=2, **found):
    return Scene(name, of_scene(found, dimensions), ABOUT)


def never(scene, method, cost):
    """The scene whose median to 99 % of the image error is not reached."""
    scene.ran[method]["took"]["image_error"]["99"][cost]["median"] = None
    return scene


@pytest.mark.parametrize(
    ("dimensions", "found", "expected"),
    [
        (2, {"newton_cg": 2, "gauss_newton": 3}, "gauss_newton"),
        (2, {"newton_cg": 2, "gauss_newton": "no residuals", "fr22": 1}, "newton_cg"),
        (FEW + 1, {"gauss_newton": 2, "local_first_order": 1}, "gauss_newton"),
        (FEW + 1, {"gauss_newton": 2, "local_gauss_newton": 3}, "local_gauss_newton"),
        (FEW + 1, {"newton_cg": 1, "local_first_order": 9}, "local_first_order"),
        (FEW + 1, {"newton_cg": 1, "first_order": 3}, "first_order"),
        (2, {"fr22": 2}, None),
    ],
)
def test_ours_is_by_the_rule_and_not_by_the_outcome(dimensions, found, expected):
    assert scene(dimensions=dimensions, **found).ours == expected


def test_ratios_are_of_medians_and_blank_where_a_level_is_not_reached():
    found = scene(gauss_newton=2, fr22=10)
    for level, cost in (("90", "evaluations"), ("99", "seconds"), ("99.9", "evaluations")):
        assert found.ratio("fr22", "gauss_newton", "image_error", level, cost) == pytest.approx(5)
    never(found, "fr22", "seconds")
    assert found.ratio("fr22", "gauss_newton", "image_error", "99", "seconds") is None
    assert found.ratio("cma_es", "gauss_newton", "image_error", "99", "seconds") is None
    found.ran["fr22"]["took"]["image_error"]["99"]["solved"] = 1
    grid = _tables.of_scene(found)[1]
    ours, theirs = grid.rows
    assert (ours.method, ours.cells[:2], ours.strong) == ("gauss_newton", ("2", "1 [0.2 s]"), True)
    assert theirs.cells[1:4] == ("5.00", "(1)", "5.00")


def test_means_are_geometric_and_over_scenes_that_both_solve():
    scenes = [scene("mug", gauss_newton=1, fr22=2), scene("shadow", gauss_newton=1, fr22=8)]
    scenes.append(scene("mirror", gauss_newton=1, fr22=1))
    never(scenes[2], "fr22", "seconds")
    ratios = _tables.ratios_to_ours(scenes, "fr22", "99", "seconds")
    assert _tables.geometric_mean(ratios) == pytest.approx(4)
    (row,) = (row for row in _tables.over(scenes, "all").rows if row.method == "fr22")
    assert row.cells[4] == "4.00 (2/3)"
    assert row.cells[1] == f"{16 ** (1 / 3):.2f} (3/3)"


def test_a_scene_that_ours_does_not_solve_says_what_others_took():
    lost = never(scene("mug", gauss_newton=2, fr22=9), "gauss_newton", "evaluations")
    theirs = _tables.of_scene(lost)[0].rows[1]
    assert theirs.cells[2] == "=18"
    (row,) = _tables.of_scenes([lost]).rows
    assert row.cells[3:] == ("- | 18, fr22", "0.4 s | 1.8 s, fr22", "2/2")


def test_lines_of_many_methods_differ_and_ours_stand_out():
    names = _registry.methods()
    ours = names[::5]
    look = looks(names, ours)
    assert list(look) == names
    assert len({(line["color"], line["linestyle"]) for line in look.values()}) == len(names)
    colours = {name: line["color"] for name, line in look.items()}
    others = [name for name in names if name not in ours]
    assert not {colours[name] for name in ours} & {colours[name] for name in others}
    assert min(look[o]["linewidth"] for o in ours) > max(look[o]["linewidth"] for o in others)


def test_pictures_are_those_of_the_first_start():
    method = lambda name: Method(name, name, lambda problem: None, "")  # type: ignore[arg-type]
    runs = {method(name): [run_of(0, 10, 2)] for name in ("gauss_newton", "fr22")}
    results = of_scene({"gauss_newton": 2, "mitsuba_ad": "no LLVM", "fr22": 3})
    results["pictures"] = _atlas.rendered(build(full=False), runs)
    pictures = _atlas.stored(results, ["gauss_newton", "fr22"])
    assert pictures is not None
    assert pictures.start.shape == (SIDE, SIDE, 3)
    assert pictures.found["fr22"] == pytest.approx(pictures.reference)
    away = _atlas.differences(pictures)
    assert away["fr22"] == pytest.approx(np.zeros((SIDE, SIDE)))
    assert away[""].max() == 1
    assert _atlas.stored(of_scene({"fr22": 2}), ["fr22"]) is None


class Page(HTMLParser):
    """Checks that what is opened is closed, and gathers what the page points to."""

    VOID = ("meta", "img", "line")

    def __init__(self):
        super().__init__()
        self.open, self.links, self.texts, self.tags = [], [], [], set()

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.links += [value for name, value in attrs if name in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)


def test_the_page_needs_no_other_file_and_says_what_the_terminal_says(
    tmp_path, monkeypatch, capsys
):
    registered(monkeypatch)
    ours = ("fr22", "wang_hvpa", "gauss_newton", "mitsuba_ad")
    monkeypatch.setattr(_registry, "methods", lambda kind=None: list(ours))
    found = {"gauss_newton": 2, "fr22": 9, "wang_hvpa": 5, "mitsuba_ad": "no <LLVM>"}
    results = of_scene(found) | {"remark": "Lost & <found>."}
    method = lambda name: Method(name, name, lambda problem: None, "")  # type: ignore[arg-type]
    runs = {method(name): [run_of(0, 10, 2)] for name in ("gauss_newton", "fr22", "wang_hvpa")}
    results["pictures"] = _atlas.rendered(build(full=False), runs)
    _study.write(ABOUT | {"title": TITLE, "tasks": {"stripes": results}}, tmp_path / "stripes")
    cli.main(["report", "stripes", "shadow", "--runs"], tmp_path)
    printed = capsys.readouterr().out
    assert "shadow has no results: python -m benchmarks run shadow" in printed

    # a report of some scenes has a page of its own
    html = (tmp_path / "report-stripes-shadow.html").read_text()
    page = Page()
    page.feed(html)
    assert page.open == []
    assert "script" not in page.tags
    assert all(link.startswith(("data:image/png;base64,", "#")) for link in page.links)
    # start, found by three, and how far each is away; the reference; four panels
    assert sum(link.startswith("data:") for link in page.links) == 2 * 4 + 1 + 4
    told = " ".join(page.texts)
    for text in ("Lost & <found>.", "no <LLVM>", "few <pixels>", "a <CPU>", "A task of the tests"):
        assert text in told
    for text in ("4.50", "1 [4]", "1 [0.4 s]"):
        assert text in told
        assert text in printed


def test_the_rule_names_methods_that_are_ours():
    assert all("(ours)" in _registry.method(name).title for name in RULE)
