"""What the page says: which method is ours, who is first, where ours loses, and the answers."""

import json
import math
from html.parser import HTMLParser

import numpy as np
import pytest
from made_scenes import ABOUT, never, of_scene, run_of, scene
from stripes import REFERENCE, SIDE, TITLE, build, registered

from benchmarks import __main__ as cli
from benchmarks import _atlas, _pictures, _registry, _study, _tables
from benchmarks._names import NAMES, OURS
from benchmarks._reached import Took, alike, machines, reached, took
from benchmarks._summary import without_one
from benchmarks._task import Method
from benchmarks.studies.report import _chart, _compare, _finder, _overall, _page, _scene
from benchmarks.studies.report._scene import MANY
from benchmarks.studies.report._standing import first, loses


@pytest.mark.parametrize(
    ("dimensions", "found", "ours", "one_number"),
    [
        (2, {"newton_cg": 2, "gauss_newton": 3}, "gauss_newton", "newton_cg"),
        (2, {"newton_cg": 2, "gauss_newton": "no residuals", "fr22": 1}, "newton_cg", "newton_cg"),
        (MANY, {"gauss_newton": 2, "local_first_order": 1}, "gauss_newton", None),
        (MANY, {"gauss_newton": 2, "local_gauss_newton": 3}, "local_gauss_newton", None),
        (MANY, {"newton_cg": 1, "local_first_order": 9}, "local_first_order", None),
        (MANY, {"newton_cg": 1, "first_order": 3}, "first_order", "first_order"),
        (2, {"fr22": 2}, None, None),
    ],
)
def test_ours_is_by_the_rule_and_not_by_the_outcome(dimensions, found, ours, one_number):
    made = scene(dimensions=dimensions, **found)
    assert (made.ours, made.with_one_number) == (ours, one_number)


def test_the_rule_names_methods_that_are_ours():
    assert {*_scene.WITH_RESIDUALS, *_scene.WITH_ONE_NUMBER} <= {*OURS}


def test_every_method_has_a_name_and_a_line_of_its_own():
    committed = {
        method
        for path in _study.COMMITTED.rglob("results.json")
        for task in json.loads(path.read_text()).get("tasks", {}).values()
        for method in task.get("methods", {})
    }
    assert {*_registry.methods(), *committed} - {*_registry.methods("descent")} <= {*NAMES}
    assert len({each.name for each in NAMES.values()}) == len(NAMES)
    assert not [each.name for each in NAMES.values() if each.name.startswith("Our")]
    lines = {name: (each.colour, each.dash) for name, each in NAMES.items()}
    alone = {line for name, line in lines.items() if not name.startswith("grey")}
    assert len(alone) == len([name for name in lines if not name.startswith("grey")])
    # warm and cold: red against blue
    warmth = lambda colour: int(colour[1:3], 16) - int(colour[5:7], 16)
    warm = {name: warmth(colour) > 100 for name, (colour, _) in lines.items()}
    assert warm == {name: name in OURS for name in NAMES}


def test_every_task_says_what_it_is_and_it_is_so():
    for name, entry in _registry.tasks().items():
        assert (entry.traits is None) == (entry.kind == "descent"), name
        found = _study.committed(name)
        if entry.traits is not None and found is not None:
            sizes = [task["dimensions"] for task in found["tasks"].values()]
            assert {*sizes} == {*entry.traits.parameters}, name
    for name in ("box2", "quad", "rosenbrock", "led", "wicker", "rocket"):
        traits, tasks = _registry.task(name).traits, _registry.family(name, full=False)
        assert traits is not None
        assert all((t.problem.residuals is not None) == traits.residuals for t in tasks), name


def test_who_is_faster_beyond_the_quartiles():
    at = lambda low, middle, high: Took(middle, low, high, 2, 2)
    assert _compare.verdict(at(1, 2, 3), at(4, 5, 6)) == "win"
    assert _compare.verdict(at(4, 5, 6), at(1, 2, 3)) == "loss"
    assert _compare.verdict(at(1, 2, 4), at(4, 5, 6)) == "tie"
    assert _compare.verdict(at(1, 2, 3), at(math.inf, math.inf, math.inf)) == "win"
    assert _compare.verdict(at(1, 2, math.inf), at(4, 5, 6)) == "tie"
    never = at(1, math.inf, math.inf)
    assert _compare.verdict(never, never) == "neither"
    assert _compare.ratio(at(1, 2, 3), at(4, 8, 9)) == 4
    assert _compare.ratio(at(1, 2, 3), never) is None
    assert _compare.ratio(at(0, 0, 0), at(1, 1, 1)) is None  # solved at the start


def test_what_rounds_to_once_as_fast_is_level():
    assert _page.in_words(1.04, "seconds") == _page.in_words(0.96, "evaluations") == "level"
    assert _page.in_words(2.0, "evaluations") == "2× fewer"
    assert _page.in_words(0.25, "seconds") == "4× slower"


def test_means_are_geometric_with_an_interval_over_scenes():
    found = _compare.mean([2, 8])
    assert found is not None
    assert found.value == pytest.approx(4)
    assert (found.low, found.high, found.scenes) == (pytest.approx(2), pytest.approx(8), 2)
    # of many, the interval is that of a mean of normal logarithms
    logs = np.random.default_rng(0).normal(0.7, 0.5, 400)
    many = _compare.mean([*np.exp(logs)])
    assert many is not None
    ends = logs.mean() + 1.96 * logs.std() / 20 * np.array([-1, 1])
    assert np.log([many.low, many.high]) == pytest.approx(ends, abs=0.005)
    assert _compare.mean([]) is None


def test_all_scenes_in_one_line():
    scenes = [scene("mug", gauss_newton=1, fr22=2, spsa=9), scene("bunny", gauss_newton=1, fr22=8)]
    scenes.append(never(scene("mirror", gauss_newton=1, fr22=1), "fr22"))
    said = _compare.in_one_line(scenes)
    assert "takes 4 times [2, 8] the evaluations and 4 times [2, 8] the seconds of ours" in said
    assert "the 2 of 3 scenes" in said
    assert "evaluations 3 wins, 0 ties, 0 losses" in said
    assert said.endswith("0 that nobody solves.")
    assert "no known share" in _compare.in_one_line([scenes[2]])
    one = _compare.in_one_line([scene(gauss_newton=1, fr22=2)])
    assert "The best peer takes 2 times the evaluations and 2 times the seconds of ours" in one
    assert "on one scene, to 99 %" in one
    assert "evaluations 1 win, 0 ties, 0 losses" in one
    (row,) = (row for row in _overall.by_method(scenes).rows if row.method == "fr22")
    assert row.cells[0] == "4 [2, 8] (2/3)"
    assert row.cells[1] == "3/0/0"


def test_a_peer_that_is_surer_wins_though_another_is_first_by_the_median():
    made = never(scene(gauss_newton=2, fr22=(2,) * 3 + (60,) * 2, cma_es=(3,) * 5), "gauss_newton")
    for level in made.ran["fr22"]["took"]["image_error"].values():
        level["evaluations"]["upper"] = None  # it gets there from three of five
    assert made.best_peer("evaluations") == "fr22"
    assert "0 wins, 0 ties, 1 loss" in _compare.in_one_line([made])


def test_seconds_are_compared_on_one_machine_only():
    made = scene("mug", gauss_newton=2, newton_cg=4, cma_es=3, fr22=1)
    for name in ("cma_es", "fr22"):
        made.ran[name]["machines"] = ["another"]
    made.ran["cma_es"]["machines"] = ["a <CPU>"]
    assert made.comparable("evaluations") == [*made.ran]
    assert made.comparable("seconds") == ["gauss_newton", "newton_cg", "cma_es"]
    assert (made.best_peer("evaluations"), made.best_peer("seconds")) == ("fr22", "cma_es")
    assert [line for line in loses(made) if "seconds" in line] == []
    assert "Fischer-FR22" not in first(made, "seconds")
    assert first(made, "seconds").endswith("That is of the 3 of 4 methods run on one machine.")
    rows = {row.method: row.cells for row in _overall.by_method([made]).rows}
    assert rows["fr22"] == ("0.5 (1/1)", "0/0/1", "", "0/0/0")
    assert rows["cma_es"][2:] == ("1.5 (1/1)", "1/0/0")
    chart = _chart.of_scene(made, ["fr22", "gauss_newton"], "image_error", "seconds")
    assert chart is not None
    assert "Fischer-FR22" not in [line.name for line in chart.lines]
    cells = {row.method: row.cells for row in reached(made.results, alike=["cma_es"]).rows}
    assert (cells["fr22"][4], cells["cma_es"][4]) == ("(0.2)", "0.6")
    assert alike(made.results, "fr22") == ["fr22"]
    assert machines(made.results).endswith("FR22 on another.")
    assert machines(scene(gauss_newton=2).results) == ""
    both = _compare.in_one_line([made, scene("bunny", gauss_newton=1, fr22=8)])
    assert "takes 2 times [0.5, 8] the evaluations" in both
    made.ran["cma_es"]["machines"] = ["another"]
    made.ran["newton_cg"]["machines"] = ["another"]
    assert first(made, "seconds").startswith("In seconds: GaussNewton 0.4 s [0.4 s, 0.4 s]. That")
    assert _overall.by_scene([made]).rows[0].cells[-1] == "elsewhere"
    both = _compare.in_one_line([made, scene("bunny", gauss_newton=1, fr22=8)])
    assert "(seconds: on 1, with the peers of one machine)" in both
    (answer,) = (a for a in _finder.answers([made]) if a.key == "fr22-few-plateaus-residuals")
    assert answer.comparable("seconds") == []
    assert answer.tally("seconds").mean is None
    assert not answer.close("seconds")


def test_where_ours_loses_is_never_left_out():
    assert loses(scene(gauss_newton=2, fr22=9)) == [
        "Nowhere beyond the quartiles, on the way or at the end."
    ]
    line, again = loses(scene(gauss_newton=9, fr22=3, spsa=6))
    behind = "Fischer-FR22, 3 times as fast; 1 other is ahead too."
    assert line == f"In evaluations to 90, 99 and 99.9 %: {behind}"
    assert again == line.replace("evaluations", "seconds")
    lost = loses(never(scene(gauss_newton=2, fr22=9), "gauss_newton"))
    assert "which gets there where ours does not" in lost[0]
    assert "To 99 % at all: Fischer-FR22 from 2 of 2 starts, ours from 0 of 2." in lost
    left = scene(gauss_newton=2, fr22=9)
    left.ran["gauss_newton"]["final"]["image_error"] = dict.fromkeys(
        ("median", "lower", "upper"), 0.1
    )
    assert loses(left) == ["At the end: Fischer-FR22 leaves 0.001 %, ours 10 %."]
    assert loses(scene(fr22=2)) == ["None of ours was run."]


def test_nothing_is_first_where_quartiles_overlap_and_one_start_may_decide():
    clear = first(scene(gauss_newton=(2,) * 5, fr22=(9,) * 5), "evaluations")
    assert (
        clear == "First in evaluations: GaussNewton (4 [4, 4]), before Fischer-FR22 (18 [18, 18])."
    )
    close = first(scene(gauss_newton=(2, 2, 3, 9, 9), fr22=(5,) * 5), "evaluations")
    assert "nothing is first" in close
    assert "hangs on one start: without it another is first by the median" in close
    assert "rests on 2 starts" in first(scene(gauss_newton=2, fr22=9), "seconds")
    alone = first(never(scene(gauss_newton=2, fr22=9), "fr22"), "evaluations")
    assert "no other gets there" in alone
    nobody = first(never(scene(gauss_newton=2), "gauss_newton"), "evaluations")
    assert "no method gets to 99 %" in nobody


def test_the_median_without_one_start():
    assert without_one([1, 2, 9]) == {"least": 2, "most": 9}
    assert without_one([1, math.inf, math.inf]) == {"least": None, "most": None}
    assert without_one([4]) == {}


def test_each_task_answers_one_question_for_each_peer_that_ran():
    scenes = [
        scene("a", 2, newton_cg=2, gauss_newton=1, cma_es=4),
        scene("b", 9, plateaus=False, newton_cg=2, gauss_newton="no residuals", cma_es=3),
        scene("c", 400, first_order=6, local_gauss_newton=1, cma_es=5, cma_es_diagonal=3),
    ]
    found = {answer.key: answer for answer in _finder.answers(scenes)}
    assert len(found) == len(_finder.PEERS) * len(_finder.SIZES) * 2 * 2
    full = {
        key: [pair.ours for pair in answer.pairs] for key, answer in found.items() if answer.pairs
    }
    assert full == {
        "cma-es-few-plateaus-number": ["newton_cg"],
        "cma-es-few-plateaus-residuals": ["gauss_newton"],
        "cma-es-some-smooth-number": ["newton_cg"],
        "cma-es-many-plateaus-number": ["first_order"],
        "cma-es-many-plateaus-residuals": ["local_gauss_newton"],
    }
    many = found["cma-es-many-plateaus-residuals"]
    assert many.pairs[0].theirs == "cma_es_diagonal"  # the better of the two
    of = many.tally("evaluations").mean
    assert of is not None
    assert of.value == pytest.approx(3)
    assert not many.close("evaluations")
    near = [scene("d", newton_cg=(2, 2, 3, 5, 5), cma_es=(3, 3, 4, 4, 4))]
    (only,) = (each for each in _finder.answers(near) if each.pairs)
    assert only.close("seconds")
    assert many.solved == (1, 1)
    assert many.starts == (2, 2, 2, 2)
    assert "needs residuals" in found["dfo-ls-few-plateaus-number"].why_none


def test_the_table_of_those_that_got_there():
    made = never(scene(gauss_newton=2, fr22=9, spsa=3, mitsuba_ad="no LLVM"), "spsa")
    (grid,), lines = _tables.ending({"tasks": {"shadow": made.results}})
    assert [row.name for row in grid.rows] == ["» GaussNewton", "Fischer-FR22"]
    assert grid.columns[1:] == ("solved", "90 %", "99 %", "99.9 %", "seconds", "left, %")
    assert grid.rows[0].cells == ("2/2", "2", "4", "6", "0.4", "0.001")
    assert lines[0].startswith("Not to 90 % from more than half of the starts")
    assert "SPSA (0.001 %)" in lines[0]
    assert lines[1] == "Mitsuba AD, Adam is not able here: no LLVM."
    assert took(made.ran["fr22"], "seconds").median == pytest.approx(1.8)


def test_lines_stay_within_their_axes():
    made = scene(gauss_newton=2, fr22=9, spsa=4)
    chart = _chart.of_scene(made, ["gauss_newton", "fr22"], "image_error", "evaluations")
    assert chart is not None
    assert [line.name for line in chart.lines] == ["", "Fischer-FR22", "GaussNewton"]
    points = " ".join(f"{line.points} {line.band}" for line in chart.lines).split()
    x, y = np.array([point.split(",") for point in points], float).T
    assert (x.min(), x.max()) == (_chart.LEFT, _chart.RIGHT)
    assert y.min() >= _chart.TOP
    assert y.max() <= _chart.BOTTOM
    assert [tick.label for tick in chart.y] == [
        "0.001 %",
        "0.01 %",
        "0.1 %",
        "1 %",
        "10 %",
        "100 %",
    ]
    assert chart.x[0].label == "10"


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


def test_views_side_by_side_are_shown_as_a_block():
    views = [np.full((4, 4, 3), shade) for shade in (0.0, 0.2, 0.4, 0.6, 0.8)]
    strip = np.concatenate(views, axis=1)
    shown = _atlas.stored({"pictures": _atlas.png(np.concatenate([strip, 1 - strip]))}, [])
    assert shown is not None
    rows = [np.concatenate(views[:3], axis=1), np.concatenate([*views[3:], views[0]], axis=1)]
    assert shown.start == pytest.approx(np.concatenate(rows))
    # what is wide, but no strip, stays
    wide = np.concatenate(views[:3], axis=1)
    shown = _atlas.stored({"pictures": _atlas.png(np.concatenate([wide, wide]))}, [])
    assert shown is not None
    assert shown.reference == pytest.approx(wide)


def test_a_film_has_what_was_found_within_so_many_evaluations(tmp_path):
    at = {f"found {mark}": np.asarray(REFERENCE) * mark / 40 for mark in _atlas.MARKS}
    method = lambda name: Method(name, name, lambda problem: None, "")  # type: ignore[arg-type]
    runs = {method(name): [run_of(0, 10, step) | at] for name, step in (("fr22", 15), ("spsa", 2))}
    shot = _atlas.film(build(full=False), runs)
    assert shot is not None
    # a step is 15 evaluations: none is done after 10, one after 20, two after 40
    assert shot["errors"] == {"fr22": [1.0, 0.1, pytest.approx(0.01)]}
    _, half, whole = _atlas.frames(shot)["fr22"]
    image = build(full=False).score.image
    assert image is not None
    sought = _atlas.display(image(REFERENCE))
    assert whole == pytest.approx(sought, abs=1 / 255)
    assert np.all(half < whole)
    results = of_scene({"fr22": 15, "spsa": 2})
    results |= {"pictures": _atlas.rendered(build(full=False), runs), "film": shot}
    _pictures.draw({"tasks": {"stripes": results}}, tmp_path)
    assert (tmp_path / "film.png").read_bytes().startswith(b"\x89PNG")


class Page(HTMLParser):
    """Checks that what is opened is closed, and gathers what the page points to."""

    VOID = ("meta", "img")

    def __init__(self):
        super().__init__()
        self.open, self.links, self.texts, self.ids = [], [], [], []

    def handle_starttag(self, tag, attrs):
        self.links += [value for name, value in attrs if name in ("src", "href")]
        self.ids += [value for name, value in attrs if name == "id"]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self.open.pop()

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
    run = run_of(0, 10, 2) | {f"found {mark}": np.asarray(REFERENCE) for mark in _atlas.MARKS}
    runs = {method(name): [run] for name in ("gauss_newton", "fr22", "wang_hvpa")}
    task = build(full=False)
    results |= {"pictures": _atlas.rendered(task, runs), "film": _atlas.film(task, runs)}
    _study.write(ABOUT | {"title": TITLE, "tasks": {"stripes": results}}, tmp_path / "stripes")
    cli.main(["report", "stripes", "shadow", "--runs"], tmp_path)
    printed = " ".join(capsys.readouterr().out.split())
    assert "shadow has no results: python -m benchmarks run shadow" in printed

    # a report of some scenes has a page of its own
    html = (tmp_path / "report-stripes-shadow.html").read_text()
    page = Page()
    page.feed(html)
    assert page.open == []
    assert len({*page.ids}) == len(page.ids)
    inside = {f"#{name}" for name in page.ids}
    assert all(link.startswith("data:image/png;base64,") or link in inside for link in page.links)
    # start, found by three, and how far each is away; the reference; three of them in the grid;
    # two methods in a film
    films = 2 * len(_atlas.MARKS)
    assert sum(link.startswith("data:") for link in page.links) == 2 * 4 + 1 + 3 + films
    told = " ".join(" ".join(page.texts).split())
    for text in ("Lost & <found>.", "no <LLVM>", "few <pixels>", "a <CPU>", "A task of the tests"):
        assert text in told
    assert "Where ours loses Nowhere beyond the quartiles" in told
    assert "python -m benchmarks run all" in told
    # the answers are there without the script, and so is the line over all scenes
    assert {f"now-{peer.key}" for peer in _finder.PEERS} <= {*page.ids}
    assert "4.5× fewer" in told
    for text in ("The best peer takes 2.5 times", "Wang-HVPA"):
        assert text in told
        assert text in printed
