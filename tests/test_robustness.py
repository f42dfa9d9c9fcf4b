"""The study of robustness: what it varies is what it says, and it is measured once."""

import json
import math
from argparse import Namespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from stripes import build, halving, registered

from benchmarks import _registry, _study
from benchmarks._grid import to_rich
from benchmarks.studies import robustness


def test_a_jpeg_is_as_far_off_as_its_level_says():
    grey = np.random.default_rng(0).uniform(size=(32, 32, 1))
    picture = np.repeat(grey, 3, axis=2)
    size = math.sqrt(np.mean(picture**2))
    for level in (0.02, 0.06, 0.14):
        error = robustness.jpeg(picture, level)
        assert math.sqrt(np.mean(error**2)) / size == pytest.approx(level, rel=0.1)
    assert not robustness.jpeg(picture, 0).any()


def test_starts_anywhere_are_within_the_bounds():
    task = robustness.anywhere(build(full=False))
    starts = np.stack([task.start(seed) for seed in range(50)])
    assert np.all((starts >= 0) & (starts <= 1))
    assert starts.std(axis=0) == pytest.approx(12**-0.5, rel=0.25)


def test_a_compressed_reference_moves_the_residuals_and_the_loss():
    task = build(full=False)
    for level, moved in ((0, False), (0.14, True)):
        changed = robustness.compressed(task, level)
        off = robustness.residuals(changed.problem)(task.score.reference)
        assert bool(np.asarray(off).any()) == moved
        found = changed.problem.loss(task.score.reference)
        assert float(found) == pytest.approx(float(jnp.mean(off**2)))


def test_runs_are_scored_by_the_parameters():
    task = robustness.scored(build(full=False))
    assert float(task.exact_loss(task.score.reference + 0.5)) == pytest.approx(0.5)
    assert task.problem.budget == robustness.BUDGET


def test_it_is_measured_drawn_and_resumed(tmp_path, monkeypatch, capsys):
    usual = lambda full, spp=4: build(full)
    registered(monkeypatch, tasks={"stripes": usual}, methods={"halving": halving})
    monkeypatch.setattr(robustness, "SCENES", ("stripes",))
    monkeypatch.setattr(robustness, "STARTS", {"quick": (5, 2)})
    monkeypatch.setattr(robustness, "USUAL", ("halving",))
    monkeypatch.setattr(robustness, "sampling", lambda number: [_registry.method("halving")])
    values = {"spp": (1, 4), "jpeg": (0, 14), "samples": (4, 6)}
    for study, few in values.items():
        monkeypatch.setattr(robustness, study.upper(), few)
    options = Namespace(said="the command", full=False, fresh=False)
    _study.run(robustness, options, tmp_path)
    assert "Robustness" in capsys.readouterr().out
    results = json.loads((tmp_path / "results.json").read_text())
    studies = results["scenes"]["stripes"]
    (starts,) = studies["starts"]["halving"]
    assert len(starts["begun"]) == len(starts["ended"]) == 5
    assert max(starts["ended"]) < 0.1
    for study, expected in values.items():
        assert tuple(line["value"] for line in studies[study]["halving"]) == expected
    # halved four times
    assert studies["jpeg"]["halving"][0]["evaluations"]["median"] == 4
    assert (tmp_path / "robustness.png").read_bytes().startswith(b"\x89PNG")
    (grid,) = robustness.tables(results)
    assert to_rich(grid).row_count == 1 + sum(map(len, values.values()))
    assert grid.rows[0].cells[:3] == ("starts", "", "halving")
    assert grid.rows[0].cells[-1] == "5/5"

    files = lambda: {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz")}
    kept = files()
    assert robustness.measure(options, tmp_path)["scenes"].keys() == results["scenes"].keys()
    assert files() == kept


@pytest.mark.slow
@pytest.mark.parametrize("name", robustness.SCENES)
def test_scenes_can_be_rendered_with_fewer_samples(name):
    build: Any = _registry.task(name).build
    usual, few = build(False), build(False, spp=1)
    losses = [float(task.problem.loss(usual.start(0))) for task in (usual, few)]
    assert losses[0] != losses[1]
    assert losses[0] == pytest.approx(losses[1], rel=0.3)
