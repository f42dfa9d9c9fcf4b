"""The scenes of Mitsuba: what is sought can be told from the picture, and plateaus are flat."""

from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import _registry
from benchmarks._task import NotAble, Task

pytest.importorskip("mitsuba")

from benchmarks.scenes import _mitsuba_ad
from benchmarks.tasks import mug
from smoothdiff.renderers import mitsuba

SCENES = [name for name, entry in _registry.tasks().items() if entry.kind == "scene"]
SCENES.remove("brdf")  # which Mitsuba has no part in


@cache
def built(name: str, full: bool = False) -> Task:
    """The task, built once: the photograph takes many samples."""
    task = _registry.task(name).build(full)
    assert isinstance(task, Task)
    return task


@pytest.fixture(params=SCENES)
def task(request):
    return built(request.param)


def test_starts_are_known_by_their_seed_and_within_the_bounds(task):
    low, high = map(np.asarray, task.problem.bounds)
    reference = np.asarray(task.score.reference)
    assert np.all((low < reference) & (reference < high))
    assert np.all(task.problem.sigma < (high - low) / 3)
    for seed in range(8):
        y = np.asarray(task.start(seed))
        assert y.dtype == np.float32
        assert y.shape == reference.shape
        assert np.all((low <= y) & (y <= high))
        assert np.array_equal(y, task.start(seed))


def test_the_reference_is_lower_than_all_starts(task):
    loss, reference = task.problem.loss, task.score.reference
    lowest = loss(reference)
    assert lowest.dtype == jnp.float32
    assert task.exact_loss(reference) == 0
    assert all(loss(task.start(seed)) > 1.1 * lowest for seed in range(4))
    assert loss(reference) == lowest  # the same noise, and nothing else has moved what it shows


@pytest.mark.slow
def test_each_parameter_can_be_told_from_the_picture(task):
    loss, reference, sigma = task.problem.loss, task.score.reference, task.problem.sigma
    for i, sought in enumerate(reference):
        for end in (bound[i] for bound in task.problem.bounds):
            moved = reference.at[i].add(jnp.clip(end - sought, -sigma, sigma))
            assert loss(moved) > 1.02 * loss(reference)


def test_full_is_more_starts_of_the_same():
    quick, full = built("occlusion"), built("occlusion", full=True)
    assert (quick.seeds, full.seeds) == (5, 20)
    assert quick.problem.loss(quick.start(1)) == full.problem.loss(full.start(1))


@pytest.mark.parametrize(
    ("name", "places"),
    [
        ("mug", [[-0.4], [0.0], [0.4]]),
        ("occlusion", [[0.0, 0.0], [0.4, -1.0], [-0.3, 1.0]]),
    ],
)
def test_what_is_hidden_changes_nothing(name, places):
    loss = built(name).problem.loss
    losses = [float(loss(jnp.asarray(y))) for y in places]
    assert losses == pytest.approx([losses[0]] * len(places), rel=1e-6)
    assert losses[0] > 2 * loss(built(name).score.reference)


def test_the_handle_turns_about_the_axis_of_the_mug():
    positions, _ = mug.handle()
    middle = (positions.min(axis=0) + positions.max(axis=0)) / 2
    for angle in (0.0, 0.7, -2.0):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        moved = middle + np.asarray(mug.move_of_handle(jnp.asarray([angle])))
        assert moved[:2] == pytest.approx(turn @ middle[:2], abs=1e-6)
        assert moved[2] == pytest.approx(middle[2])


def test_a_picture_for_the_score_does_not_move_what_the_method_sees():
    """They have meshes of their own; the loss does not render what has not moved anew."""
    loss, reference = built("mug").problem.loss, built("mug").score.reference
    before = loss(reference)
    built("mug").exact_loss(built("mug").start(0))
    assert loss(reference) == before


def test_glass_is_tinted_and_bends_light():
    image = built("glass-ball").score.image
    assert image is not None
    clear = np.asarray(image(jnp.asarray([1.0, 1.0, 1.0, 0.5])))
    red = np.asarray(image(jnp.asarray([1.0, 0.0, 0.0, 0.5])))
    assert np.allclose(clear[..., 0], red[..., 0])
    assert red[12:20, 12:20, 1:].mean() < 0.2 * clear[12:20, 12:20, 1:].mean()
    bent = np.asarray(image(jnp.asarray([1.0, 1.0, 1.0, 0.3])))
    assert np.abs(bent - clear).mean() > 0.02


def test_without_llvm_there_is_no_gradient_of_the_renderer(monkeypatch):
    monkeypatch.setattr(mitsuba, "available", lambda variant: variant == "scalar_rgb")
    native_ad = built("bunny").problem.native_ad
    assert native_ad is not None
    with pytest.raises(NotAble, match="libllvm"):
        native_ad()


@pytest.mark.slow
@pytest.mark.skipif(not mitsuba.available(_mitsuba_ad.VARIANT), reason="needs libllvm")
@pytest.mark.parametrize("name", ["bunny", "shadow"])
def test_the_renderers_own_gradient(name):
    found = built(name)
    assert found.problem.native_ad is not None
    value_and_grad = found.problem.native_ad()
    y = found.score.reference + 0.1 * (-1.0) ** np.arange(found.score.reference.size)
    several = [value_and_grad(jnp.float32(y + 1e-4 * i)) for i in range(8)]
    loss, gradient = (np.mean([np.asarray(x[k]) for x in several], axis=0) for k in (0, 1))
    assert loss == pytest.approx(float(found.problem.loss(y)), rel=0.2)
    for i, slope in enumerate(gradient):
        up, down = (found.exact_loss(y.at[i].add(h)) for h in (0.08, -0.08))
        assert slope == pytest.approx(float((up - down) / 0.16), rel=0.4)
