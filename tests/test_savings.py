"""What savings are worth: dearer renders show the same scene, and the table says what was timed."""

import json

import numpy as np
import pytest

from benchmarks import savings, tasks
from benchmarks._summary import _of_method
from benchmarks.report import _savings
from benchmarks.report._scene import Scene
from benchmarks.scenes._dearer import SAVINGS


def test_dearer_renders_are_of_the_same_scene():
    task = tasks.module("mug").build(False)
    assert task.dearer is not None
    assert task.residuals is not None
    y = task.start(0)
    renders = task.dearer()
    assert set(renders) == {"", *SAVINGS}
    pictures = {name: np.asarray(render(y)) for name, render in renders.items()}
    usual = pictures[""]
    moved = np.asarray(task.residuals(y) - task.residuals(task.reference))
    assert usual - np.asarray(renders[""](task.reference)) == pytest.approx(moved, abs=1e-6)
    assert np.array_equal(pictures["updates"], usual)
    for name in ("integrator", "samples"):
        assert pictures[name].shape == usual.shape
        assert not np.array_equal(pictures[name], usual)
    assert pictures["resolution"].shape == pictures["all"].shape == (64, 64, 3)
    for picture in pictures.values():
        assert picture.mean() == pytest.approx(usual.mean(), rel=0.1)


def run(evaluations):
    return {
        "evaluations": [0, evaluations],
        "seconds": [0.0, 0.5],
        "image_error": [1.0, 0.001],
        "parameter_error": [1.0, 0.001],
        "distance": 0.0,
        "warm_up_seconds": 0.0,
    }


def test_the_table_multiplies_renders_by_evaluations():
    results = {
        "scenes": {
            name: {"milliseconds": {"": 10.0, **dict.fromkeys(SAVINGS, 30.0)}}
            for name in ("mug", "shadow")
        }
    }
    ran = {"title": "GaussNewton (ours)", **_of_method([run(100)])}
    scene = Scene("mug", {"dimensions": 1, "methods": {"gauss_newton": ran}})
    grid = _savings.table(results, [scene])
    mug, shadow = (row.cells for row in grid.rows)
    assert mug == ("1 s", "10.0 ms", *["2 s (3)"] * len(SAVINGS), "-", "0.5 s")
    assert shadow == ("-", "10.0 ms", *["(3)"] * len(SAVINGS), "-", "-")
    assert all(len(row.cells) + 1 == len(grid.columns) for row in grid.rows)


def test_it_is_measured_drawn_and_printed(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(savings, "ROUNDS", 1)
    monkeypatch.setenv("COLUMNS", "200")
    savings.main(tmp_path / "savings", ["global-illumination", "brdf"])
    assert "global-illumination" in capsys.readouterr().out
    results = json.loads((tmp_path / "savings" / "results.json").read_text())
    assert list(results["scenes"]) == ["global-illumination"]  # brdf has none
    took = results["scenes"]["global-illumination"]["milliseconds"]
    assert all(milliseconds > 0 for milliseconds in took.values())
    assert took["all"] > took[""]
    assert (tmp_path / "savings" / "savings.png").read_bytes().startswith(b"\x89PNG")
