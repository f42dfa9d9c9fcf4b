"""The report of the scenes, and the command that runs all of them.

This module is itself a task and some methods that the command line is given.
"""

import json
import os
import signal
import subprocess
import sys
import types
from html.parser import HTMLParser
from pathlib import Path

import jax
import numpy as np
import pytest
from stripes import SIDE, TITLE, build, halving

from benchmarks import __main__ as cli
from benchmarks import methods, tasks
from benchmarks._style import looks
from benchmarks._summary import _of_method
from benchmarks._task import NotAble
from benchmarks.report import _atlas, _goals, _paper, _tables
from benchmarks.report._scene import FEW, RULE, Scene

MACHINE = {"cpu": "a <CPU>", "cores": 2, "python": "3.11", "versions": {"jax": "1"}}


@pytest.fixture(autouse=True)
def standard_promotion():
    """optax's own Adam does not run under strict promotion."""
    with jax.numpy_dtype_promotion("standard"):
        yield


def failing(task):
    raise RuntimeError("no luck\nat all")


def killing(task):
    """Ends the process, as a kill from outside would, in its second run."""
    solve = halving(task)

    def killed(y0, key, record):
        if float(y0[1]) == 0.1875:
            os.kill(os.getpid(), signal.SIGKILL)
        solve(y0, key, record)

    return killed


VARIANTS = {
    "halving": ("Halving", halving),
    "failing": ("Failing", failing),
    "killing": ("Halving", halving),
}


def run_of(seed, factor, evaluations):
    """A run whose errors fall by `factor` a step of so many evaluations, which take 0.1 s each."""
    errors = [factor**-i for i in range(6)]
    return {
        "seed": seed,
        "ended": "by the method",
        "evaluations": [evaluations * i for i in range(6)],
        "seconds": [0.1 * evaluations * i for i in range(6)],
        "image_error": errors,
        "parameter_error": errors,
        "distance": errors[-1],
        "found": [0.25, 0.5],
        "warm_up_seconds": 1.0,
    }


def results_of(found, dimensions=2):
    """The results of a scene: method -> evaluations of a step, or a reason."""
    return {
        "task": "stripes",
        "title": TITLE,
        "setting": "quick",
        "notes": "few <pixels>",
        "budget": {"evaluations": 60, "seconds": 60},
        "sigma": 0.3,
        "dimensions": dimensions,
        "command": "python -m benchmarks run all",
        "machine": MACHINE,
        "methods": {
            name: {"title": name.title()}
            | (
                {"not_able": took}
                if isinstance(took, str)
                else _of_method([run_of(seed, 10, took) for seed in range(2)])
            )
            for name, took in found.items()
        },
    }


def scene(name="shadow", dimensions=2, **found):
    return Scene(name, results_of(found, dimensions))


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
    found.ran["fr22"]["image_error"]["levels"]["99"]["seconds"]["median"] = None
    assert found.ratio("fr22", "gauss_newton", "image_error", "99", "seconds") is None
    assert found.ratio("cma_es", "gauss_newton", "image_error", "99", "seconds") is None
    found.ran["fr22"]["image_error"]["levels"]["99"]["solved"] = 1
    grid = _tables.of_scene(found)[1]
    ours, theirs = grid.rows
    assert (ours.method, ours.cells[:2], ours.strong) == ("gauss_newton", ("2", "1 [0.2 s]"), True)
    assert theirs.cells[1:4] == ("5.00", "(1)", "5.00")


def test_means_are_geometric_and_over_scenes_that_both_solve():
    scenes = [scene("mug", gauss_newton=1, fr22=2), scene("shadow", gauss_newton=1, fr22=8)]
    scenes.append(scene("mirror", gauss_newton=1, fr22=1))
    scenes[2].ran["fr22"]["image_error"]["levels"]["99"]["seconds"]["median"] = None
    ratios = _tables.ratios_to_ours(scenes, "fr22", "99", "seconds")
    assert _tables.geometric_mean(ratios) == pytest.approx(4)
    (row,) = (row for row in _tables.over(scenes, "all").rows if row.method == "fr22")
    assert row.cells[4] == "4.00 (2/3)"
    assert row.cells[1] == f"{16 ** (1 / 3):.2f} (3/3)"


def test_goals_say_what_was_won_lost_and_not_run():
    met = {
        row.name: row.cells
        for row in _goals.table(
            [
                scene("mug", gauss_newton=2, fr22=9, our_hvpa=4, mitsuba_ad=1),
                scene("bunny", gauss_newton=2, newton_cg=1, mitsuba_ad=3, cma_es=2),
            ]
        ).rows
    }
    evaluations, seconds, fr22, our_hvpa, bunny, texture, *_ = met.values()
    assert evaluations == ("on 1 of 2; not on mug (mitsuba_ad 2, ours 4)", "no")
    assert seconds == ("on 2 of 2", "yes")
    assert fr22[0].startswith("4.50 times the seconds, 4.50 times the evaluations, on 1 of 1")
    assert (fr22[1], our_hvpa[1], bunny[1], texture) == ("yes", "no", "yes", ("not run", "-"))


def test_a_scene_that_ours_does_not_solve_is_lost():
    lost = scene("mug", gauss_newton=2, fr22=9)
    lost.ran["gauss_newton"]["image_error"]["levels"]["99"]["evaluations"]["median"] = None
    measured, met = _goals.table([lost]).rows[0].cells
    assert met == "no"
    assert "ours does not get there" in measured
    theirs = _tables.of_scene(lost)[0].rows[1]
    assert theirs.cells[2] == "=18"


def test_the_papers_table_is_about_methods_that_are_here():
    for ratios in _paper.TABLE_2.values():
        assert set(ratios) <= set(_paper.TITLES) <= set(methods.METHODS)
    grid = _tables.beside_the_paper([scene("mug", gauss_newton=1, our_hvpa=4, fr22=12)])
    assert grid is not None
    rows = {row.name: row.cells for row in grid.rows}
    assert rows["FR22"] == ("3.00 (1)", "5.92 (1)", "3.00 (1)", "5.69 (1)")
    assert rows["Ours, by the rule"] == ("0.25 (1)", "", "0.25 (1)", "")
    assert _tables.beside_the_paper([scene("mirror", gauss_newton=1, our_hvpa=4)]) is None


def test_lines_of_many_methods_differ_and_ours_stand_out():
    names = list(methods.METHODS)
    ours = names[::5]
    look = looks(names, ours)
    assert list(look) == names
    assert len({(line["color"], line["linestyle"]) for line in look.values()}) == len(names)
    colours = {name: line["color"] for name, line in look.items()}
    others = [name for name in names if name not in ours]
    assert not {colours[name] for name in ours} & {colours[name] for name in others}
    assert min(look[o]["linewidth"] for o in ours) > max(look[o]["linewidth"] for o in others)


def test_pictures_are_those_of_the_first_start(tmp_path):
    task = build(full=False)
    results = results_of({"gauss_newton": 2, "mitsuba_ad": "no LLVM", "fr22": 3})
    _atlas.store(task, results, tmp_path)
    pictures = _atlas.load(results, tmp_path)
    assert pictures is not None
    assert list(pictures.found) == ["gauss_newton", "fr22"]
    assert pictures.start.shape == (SIDE, SIDE, 3)
    assert pictures.found["fr22"] == pytest.approx(pictures.reference)
    away = _atlas.differences(pictures)
    assert away["fr22"] == pytest.approx(np.zeros((SIDE, SIDE)))
    assert away[""].max() == 1
    assert _atlas.load(results_of({"fr22": 2}), tmp_path / "none") is None


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
    monkeypatch.setitem(tasks.TASKS, "stripes", __name__)
    monkeypatch.setenv("COLUMNS", "250")
    folder = tmp_path / "stripes"
    folder.mkdir()
    found = {"gauss_newton": 2, "fr22": 9, "our_hvpa": 5, "mitsuba_ad": "no <LLVM>"}
    (folder / "results.json").write_text(json.dumps(results_of(found)))
    (folder / "remark.txt").write_text("Lost & <found>.\n")
    cli.main(["report", "stripes", "shadow"], tmp_path)
    printed = capsys.readouterr().out
    assert "shadow has no results: python -m benchmarks run shadow" in printed

    html = (tmp_path / "report.html").read_text()
    page = Page()
    page.feed(html)
    assert page.open == []
    assert "script" not in page.tags
    assert all(link.startswith(("data:image/png;base64,", "#")) for link in page.links)
    # start, found by three, and how far each is away; the reference; four panels
    assert sum(link.startswith("data:") for link in page.links) == 2 * 4 + 1 + 4
    told = " ".join(page.texts)
    for text in ("Lost & <found>.", "no <LLVM>", "few <pixels>", "a <CPU>", "This module is"):
        assert text in told
    for text in ("4.50", "1 [4]", "1 [0.4 s]", "Set before anything was run."):
        assert text in told
        assert text in printed
    assert (folder / _atlas.NAME).exists()


@pytest.fixture
def scenes(monkeypatch):
    """The command line with some scenes of which only one can be run, and its methods."""

    def not_able(full):
        raise NotAble("it lacks light")

    def broken(full):
        raise ZeroDivisionError("by zero")

    modules = {
        "dark": types.SimpleNamespace(TITLE="Dark", build=not_able),
        "broken": types.SimpleNamespace(TITLE="Broken", build=broken),
        "stripes": sys.modules[__name__],
    }
    monkeypatch.setattr(tasks, "ALL_SCENES", dict.fromkeys(modules, ""))
    monkeypatch.setattr(tasks, "module", modules.__getitem__)
    for name in VARIANTS:
        monkeypatch.setitem(methods.METHODS, name, __name__)
    monkeypatch.setenv("COLUMNS", "150")


def test_all_scenes_are_run_and_failures_are_named(scenes, tmp_path, capsys):
    cli.main(["run", "all", "--methods", "failing,halving"], tmp_path)
    shown = capsys.readouterr()
    assert "dark is not able here: it lacks light." in shown.out
    assert "broken is not able here: failed: ZeroDivisionError: by zero." in shown.out
    assert "Failing is not able here: failed: RuntimeError: no luck." in shown.out
    assert "4/4" in shown.err  # one bar, which forgets what cannot be run
    results = json.loads((tmp_path / "stripes" / "results.json").read_text())
    assert results["methods"]["halving"]["image_error"]["levels"]["99.9"]["solved"] == 2
    assert (tmp_path / "stripes" / _atlas.NAME).exists()


def test_an_interruption_ends_all_scenes(scenes, tmp_path, monkeypatch):
    def interrupted(task):
        raise jax.errors.JaxRuntimeError("KeyboardInterrupt: ")

    monkeypatch.setitem(VARIANTS, "halving", ("Halving", interrupted))
    with pytest.raises(KeyboardInterrupt):
        cli.main(["run", "all", "--methods", "halving"], tmp_path)


def test_nothing_is_lost_by_a_kill(scenes, tmp_path):
    script = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
import test_report as here
from benchmarks import __main__ as cli, methods, tasks
here.VARIANTS["killing"] = ("Halving", here.killing)
methods.METHODS["killing"] = tasks.TASKS["stripes"] = "test_report"
tasks.ALL_SCENES = {"stripes": ""}
cli.main(["run", "all", "--methods", "killing"], Path(sys.argv[2]))
"""
    here = Path(__file__).parent
    command = [sys.executable, "-c", script, str(here), str(tmp_path)]
    killed = subprocess.run(command, cwd=here.parent, capture_output=True, text=True)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    (kept,) = (tmp_path / "stripes" / "runs").glob("*.json")
    before = kept.read_text()
    cli.main(["run", "all", "--methods", "killing"], tmp_path)
    assert kept.read_text() == before
    results = json.loads((tmp_path / "stripes" / "results.json").read_text())
    assert results["methods"]["killing"]["starts"] == 2


def test_the_usual_methods_of_a_scene_are_methods():
    assert set(methods.SCENES) <= set(methods.METHODS)
    for name in tasks.ALL_SCENES:
        assert set(getattr(tasks.module(name), "METHODS", ())) <= set(methods.METHODS)


def test_the_rule_names_methods_that_are_ours():
    assert set(RULE) <= set(methods.METHODS)
    assert all("(ours)" in methods.load(name).title for name in RULE)
