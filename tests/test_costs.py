"""What derivatives, filters and savings cost: measured as they claim, drawn and shown."""

import json
from argparse import Namespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from made_scenes import never, scene

import smoothdiff as sd
from benchmarks import _registry, _study
from benchmarks._task import Task
from benchmarks.scenes.mitsuba_scene import SAVINGS
from benchmarks.studies import _startup, filters, overhead, savings

OPTIONS = Namespace(said="a test")


@pytest.fixture(autouse=True)
def wide(monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")


def shown(study, lines, folder, capsys):
    """What is printed of results, which are drawn too."""
    found = _study.write(lines, folder)
    study.draw(found, folder)
    (picture,) = folder.glob("*.png")
    assert picture.read_bytes().startswith(b"\x89PNG")
    _study.show(study.tables(found))
    return capsys.readouterr().out


@pytest.mark.slow
def test_overhead_compares_at_the_same_points():
    seen = []

    def loss(y):
        jax.debug.callback(lambda y: seen.append(np.asarray(y)), y)
        return jnp.sum(y)

    key, y, sampler = jax.random.key(0), jnp.linspace(0, 1, 3), overhead.SAMPLER
    for call in (
        sd.smooth_grad(loss, 0.1, num_samples=4, sampler=sampler, baseline="none"),
        overhead.evaluating(loss, 0.1, sampler, 4),
    ):
        jax.block_until_ready(call(key, y))
        jax.effects_barrier()
    used = np.stack(seen)
    first, second = (points[points[:, 0].argsort()] for points in (used[:4], used[4:]))
    assert first == pytest.approx(second)


def test_overhead_is_drawn_and_shown(tmp_path, capsys):
    line = {"transform": "smooth_grad", "ratio": [1.0, 1.01, 1.05], "ms": 2.0}
    found = {"samples": 256, "turns": 2, "target": 1.1, "lines": [line]}
    found |= {"startup": [{"solver": "GaussNewton", "to the first step": 1.375}]}
    text = shown(overhead, found, tmp_path, capsys)
    assert "1.01 [1, 1.05]" in text
    assert "1.38" in text


@pytest.mark.slow
def test_overhead_is_measured(monkeypatch, tmp_path):
    monkeypatch.setattr(overhead, "TURNS", 2)
    monkeypatch.setattr(_startup, "PROCESSES", 1)
    _study.run(overhead, OPTIONS, tmp_path)
    for line in json.loads((tmp_path / "results.json").read_text())["lines"]:
        assert 0 < line["ratio"][0] <= line["ratio"][1] <= line["ratio"][2]


@pytest.mark.slow
def test_filters_are_measured_drawn_and_shown(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(filters, "SPACES", {"8²": (8, 8)})
    monkeypatch.setattr(filters, "TURNS", 2)
    found = filters.measure(OPTIONS, tmp_path)
    assert "8², 3 channels" in shown(filters, found, tmp_path, capsys)
    for line in found["lines"]:
        assert line["ratio"][0] * line["ms of floor"] <= line["ms"] * 1.001


def test_renders_are_multiplied_by_evaluations(tmp_path, capsys):
    milliseconds = {"": 10.0, **dict.fromkeys(SAVINGS, 30.0)}
    known = {"evaluations": 100, "first order": None, "second order": 0.5}
    scenes = {
        "mug": {"milliseconds": milliseconds} | known,
        "shadow": {"milliseconds": milliseconds} | dict.fromkeys(known),
    }
    printed = shown(savings, {"scenes": scenes}, tmp_path, capsys).splitlines()
    mug, shadow = (next(line for line in printed if name in line) for name in ("mug", "shadow"))
    assert mug.split("  ")[1].strip() == "mug"
    assert mug.count("2 s (3)") == len(SAVINGS)
    assert "1 s " in mug
    assert "0.5" in mug
    assert shadow.count("(3)") == len(SAVINGS)
    assert " s " not in shadow


def test_what_ours_takes_to_99_percent_is_read_from_results(monkeypatch, tmp_path):
    made = never(scene("mug", gauss_newton=7, newton_cg=5, first_order=1), "first_order")
    monkeypatch.setattr(savings, "load", lambda name, folder: [made][folder != tmp_path :])
    found = savings.to_99("mug", (tmp_path / "other", tmp_path))
    assert found == {"evaluations": 14, "first order": None, "second order": pytest.approx(1)}
    assert set(savings.to_99("mug", ()).values()) == {None}


def test_dearer_renders_are_of_the_same_scene():
    task = _registry.task("mug").build(False)
    assert isinstance(task, Task)
    assert task.dearer is not None
    residuals = task.problem.residuals
    assert residuals is not None
    y = task.start(0)
    renders = task.dearer()
    assert set(renders) == {"", *SAVINGS}
    pictures = {name: np.asarray(render(y)) for name, render in renders.items()}
    usual, reference = pictures[""], task.score.reference
    moved = np.asarray(residuals(y) - residuals(reference))
    assert usual - np.asarray(renders[""](reference)) == pytest.approx(moved, abs=1e-6)
    assert np.array_equal(pictures["updates"], usual)
    for name in ("integrator", "samples"):
        assert pictures[name].shape == usual.shape
        assert not np.array_equal(pictures[name], usual)
    assert pictures["resolution"].shape == pictures["all"].shape == (64, 64, 3)
    for picture in pictures.values():
        assert picture.mean() == pytest.approx(usual.mean(), rel=0.1)


@pytest.mark.slow
def test_savings_are_measured_drawn_and_printed(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(savings, "TURNS", 1)
    monkeypatch.setattr(_registry, "scenes", lambda: ["global-illumination", "brdf"])
    _study.run(savings, OPTIONS, tmp_path / "savings")
    assert "global-illumination" in capsys.readouterr().out
    results = json.loads((tmp_path / "savings" / "results.json").read_text())
    assert list(results["scenes"]) == ["global-illumination"]  # brdf has none
    took = results["scenes"]["global-illumination"]["milliseconds"]
    assert all(milliseconds > 0 for milliseconds in took.values())
