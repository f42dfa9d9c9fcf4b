"""The study of robustness: what it varies is what it says, and it is measured once."""

import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stripes import build, halving

from benchmarks import methods, robustness, tasks
from benchmarks.robustness import _studies


@pytest.fixture(autouse=True)
def standard_promotion():
    """optax's own Adam does not run under strict promotion."""
    with jax.numpy_dtype_promotion("standard"):
        yield


VARIANTS = {"halving": ("Halving", halving)}


def test_a_jpeg_is_as_far_off_as_its_level_says():
    grey = np.random.default_rng(0).uniform(size=(32, 32, 1))
    picture = np.repeat(grey, 3, axis=2)
    size = math.sqrt(np.mean(picture**2))
    for level in (0.02, 0.06, 0.14):
        error, quality = _studies._jpeg(picture, level)
        assert math.sqrt(np.mean(error**2)) / size == pytest.approx(level, rel=0.1)
        assert quality is not None
    nothing, none = _studies._jpeg(picture, 0)
    assert none is None
    assert not nothing.any()


def test_starts_anywhere_are_within_the_bounds():
    starts = np.stack(_studies.anywhere(build(full=False), 50))
    assert np.all((starts >= 0) & (starts <= 1))
    assert starts.std(axis=0) == pytest.approx(12**-0.5, rel=0.25)


def test_one_compiled_task_shows_each_change_in_turn():
    task = build(full=False)
    plus = lambda more: lambda y: _studies.residuals(task)(y) + more
    starts = [task.start(0), task.start(1)]
    changes = [_studies.Change("spp", i, plus(float(i)), starts) for i in range(3)]
    both = _studies.together(task, changes)
    assert both.choose is not None
    assert both.residuals is not None
    sought = task.reference
    traced = []

    @jax.jit
    def losses(y):
        traced.append(y)
        return jax.vmap(both.loss)(jnp.stack([y, y]))

    for seed in range(6):
        assert both.choose(seed) is sought
        assert np.array_equal(both.start(seed), starts[seed % 2])
        assert np.asarray(both.residuals(sought)) == pytest.approx(seed // 2)
        assert np.asarray(losses(sought)) == pytest.approx((seed // 2) ** 2)
    assert len(traced) == 1


def test_a_compressed_reference_moves_the_residuals():
    task = build(full=False)
    same, off = (_studies.compressed(task, level)(task.reference) for level in (0, 14))
    assert not np.asarray(same).any()
    assert float(jnp.mean(off**2)) > 0


def test_it_is_measured_drawn_and_resumed(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(robustness, "SCENES", ("stripes", "not-there"))
    monkeypatch.setitem(tasks.TASKS, "stripes", __name__)
    monkeypatch.setitem(methods.METHODS, "halving", __name__)
    monkeypatch.setattr(_studies, "USUAL", ("halving",))
    monkeypatch.setattr(_studies, "sampling", lambda num: [methods.load("halving")])
    monkeypatch.setenv("COLUMNS", "150")
    setting = robustness.Setting("quick", starts=5, seeds=2)
    robustness.main(tmp_path, "the command", setting=setting)
    assert "robustness" in capsys.readouterr().out.lower()
    first = (tmp_path / "results.json").read_text()
    studies = json.loads(first)["scenes"]["stripes"]
    (starts,) = studies["starts"]["halving"]
    assert len(starts["begun"]) == len(starts["ended"]) == 5
    assert max(starts["ended"]) < 0.1
    values = {"jpeg": _studies.JPEG, "spp": _studies.SPP, "samples": _studies.SAMPLES}
    for study, expected in values.items():
        assert tuple(line["value"] for line in studies[study]["halving"]) == expected
    # halved four times
    assert studies["jpeg"]["halving"][0]["evaluations"]["median"] == 4
    assert (tmp_path / "robustness.png").read_bytes().startswith(b"\x89PNG")
    robustness.main(tmp_path, "the command", setting=setting)
    assert (tmp_path / "results.json").read_text() == first


@pytest.mark.parametrize("name", robustness.SCENES)
def test_scenes_can_be_rendered_with_fewer_samples(name):
    usual, few = (tasks.module(name).build(False, **spp) for spp in ({}, {"spp": 1}))
    losses = [float(task.loss(usual.start(0))) for task in (usual, few)]
    assert losses[0] != losses[1]
    assert losses[0] == pytest.approx(losses[1], rel=0.3)
