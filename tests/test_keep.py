"""What was run takes its place among committed results, method by method."""

import numpy as np
import pytest
from made_scenes import ABOUT, MACHINE, of_scene, run_of
from stripes import REFERENCE, build, registered

from benchmarks import __main__ as cli
from benchmarks import _atlas, _study
from benchmarks._keep import keep, merged
from benchmarks._machine import here, in_one_line
from benchmarks._task import Method

COLOURS = {"fr22": 0.2, "cma_es": 0.4, "gauss_newton": 0.6}  # of what each found


def results(command, **found):
    """Results with pictures and a film, where each method found its own picture."""
    method = lambda name: Method(name, name, lambda problem: None, "")  # type: ignore[arg-type]
    runs = {}
    for name, step in found.items():
        at = np.full_like(np.asarray(REFERENCE), COLOURS[name] * (0.5 if command == "old" else 1))
        seen = {f"found {mark}": at for mark in _atlas.MARKS}
        runs[method(name)] = [run_of(0, 10, step) | {"found": at} | seen]
    task = build(full=False)
    shown = {"pictures": _atlas.rendered(task, runs), "film": _atlas.film(task, runs)}
    made = of_scene(found) | shown
    return ABOUT | {"command": command, "title": "Stripes", "tasks": {"stripes": made}}


def test_a_method_that_was_run_takes_its_place_and_the_others_stay():
    old, new = results("old", fr22=9, gauss_newton=2), results("new", cma_es=5, gauss_newton=3)
    old["tasks"]["stripes"]["remark"] = "FR22 takes 9."
    for found in old["tasks"]["stripes"]["methods"].values():
        del found["machines"]  # as results were once
    task = (both := merged(old, new))["tasks"]["stripes"]
    assert both["command"] == "old; new"
    assert [*task["methods"]] == ["cma_es", "fr22", "gauss_newton"]  # ours last
    assert task["methods"]["gauss_newton"]["machines"] == ["a <CPU>"]
    assert task["methods"]["fr22"]["machines"] == [in_one_line(MACHINE)]
    steps = {n: each["took"]["image_error"]["90"] for n, each in task["methods"].items()}
    assert [of["evaluations"]["median"] for of in steps.values()] == [5, 9, 3]
    assert "remark" not in task  # it was on the old numbers
    pictures = _atlas.stored(task, [*task["methods"]])
    assert pictures is not None
    said = {name: picture.mean() for name, picture in pictures.found.items()}
    grey = lambda value: float(_atlas.display(value))
    assert said == pytest.approx(
        {"cma_es": grey(0.4), "fr22": grey(0.1), "gauss_newton": grey(0.6)}, abs=0.003
    )
    assert [*task["film"]["errors"]] == ["cma_es", "fr22", "gauss_newton"]
    frames = {name: each[0].mean() for name, each in _atlas.frames(task["film"]).items()}
    assert frames == pytest.approx(said)


def test_what_was_measured_otherwise_does_not_stand_beside_it():
    old, new = results("old", fr22=9), results("new", cma_es=5)
    new["tasks"]["stripes"]["budget"] = {"evaluations": 1, "seconds": 1}
    with pytest.raises(SystemExit, match="another budget than in what is committed"):
        merged(old, new)


def test_the_command_writes_what_was_run(tmp_path, monkeypatch):
    registered(monkeypatch)
    monkeypatch.setattr(_study, "COMMITTED", tmp_path / "results")
    cli.main(["run", "stripes", "--methods", "halving"], tmp_path / "runs")
    cli.main(["keep", "stripes"], tmp_path / "runs")
    found = _study.committed("stripes", tmp_path / "results")
    assert found is not None
    assert found["tasks"]["stripes"]["methods"]["halving"]["machines"] == [here()]
    assert keep("stripes", tmp_path / "runs", tmp_path / "results") == found
    with pytest.raises(SystemExit, match="python -m benchmarks run other"):
        keep("other", tmp_path / "runs", tmp_path / "results")
