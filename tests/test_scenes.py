"""The scenes of Mitsuba: what is sought can be told from the picture, and plateaus are flat."""

import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import tasks
from benchmarks._task import NotAble, Task

pytest.importorskip("mitsuba")

from benchmarks.scenes import _mitsuba_ad, bunny, mug
from smoothdiff.renderers import mitsuba

HERE = [name for name in tasks.SCENES if name not in tasks.BLACK_BOXES]
BUILT: dict[str, Task] = {}


def built(name: str) -> Task:
    """The task, built once: the photograph takes many samples."""
    return BUILT.setdefault(name, tasks.module(name).build(False))


@pytest.fixture(params=HERE)
def task(request):
    return built(request.param)


def with_entry(y, i, value):
    return jnp.asarray(y).at[i].set(value)


def test_the_reference_is_lower_than_all_starts(task):
    loss = jax.jit(task.loss)
    lowest = loss(task.reference)
    assert loss(task.reference) == lowest  # the same noise
    assert lowest.dtype == jnp.float32
    assert task.exact_loss(task.reference) == 0
    for seed in range(8):
        assert loss(task.start(seed)) > 1.1 * lowest


def test_each_parameter_can_be_told_from_the_picture(task):
    low, high = task.bounds
    for i, sought in enumerate(task.reference):
        for end in (low[i], high[i]):
            away = sought + jnp.clip(end - sought, -task.sigma, task.sigma)
            moved = with_entry(task.reference, i, away)
            assert task.loss(moved) > 1.02 * task.loss(task.reference)


def test_starts_and_the_reference_are_within_the_bounds(task):
    low, high = task.bounds
    assert np.all((low < task.reference) & (task.reference < high))
    assert np.all(task.sigma < (high - low) / 3)
    for seed in range(8):
        y = task.start(seed)
        assert y.dtype == jnp.float32
        assert y.shape == task.reference.shape
        assert np.all((low <= y) & (y <= high))
        assert np.array_equal(y, task.start(seed))


def test_the_loss_is_the_mean_of_the_squared_residuals(task):
    assert task.residuals is not None
    y = task.start(0)
    mean = np.mean(np.asarray(task.residuals(y)) ** 2)
    assert mean == pytest.approx(float(task.loss(y)), rel=1e-5)


def test_full_is_more_starts_of_the_same():
    quick, full = built("occlusion"), tasks.module("occlusion").build(True)
    assert (quick.seeds, full.seeds) == (5, 20)
    assert quick.loss(quick.start(1)) == full.loss(full.start(1))


@pytest.mark.parametrize(
    ("name", "places"),
    [
        ("mug", [[-0.4], [0.0], [0.4]]),
        ("occlusion", [[0.0, 0.0], [0.4, -1.0], [-0.3, 1.0]]),
    ],
)
def test_what_is_hidden_changes_nothing(name, places):
    losses = [float(built(name).loss(jnp.asarray(y))) for y in places]
    assert losses == pytest.approx([losses[0]] * len(places), rel=1e-6)
    assert losses[0] > 2 * built(name).loss(built(name).reference)


def test_the_handle_turns_about_the_axis_of_the_mug():
    positions, _ = mug.handle()
    middle = (positions.min(axis=0) + positions.max(axis=0)) / 2
    for angle in (0.0, 0.7, -2.0):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        moved = middle + np.asarray(mug.move_of_handle(jnp.asarray([angle])))
        assert moved[:2] == pytest.approx(turn @ middle[:2], abs=1e-6)
        assert moved[2] == pytest.approx(middle[2])


def test_meshes_are_closed_and_look_outwards():
    positions, faces = bunny.body()
    corners = positions[faces]
    assert np.all(np.linalg.det(corners) > 0)
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    assert len(np.unique(edges, axis=0)) == len(edges)
    assert {tuple(edge) for edge in edges} == {tuple(edge[::-1]) for edge in edges}


def test_glass_is_tinted_and_bends_light():
    found = built("glass-ball")
    assert found.image is not None
    clear = np.asarray(found.image(jnp.asarray([1.0, 1.0, 1.0, 0.5])))
    red = np.asarray(found.image(jnp.asarray([1.0, 0.0, 0.0, 0.5])))
    assert np.allclose(clear[..., 0], red[..., 0])
    assert red[12:20, 12:20, 1:].mean() < 0.2 * clear[12:20, 12:20, 1:].mean()
    bent = np.asarray(found.image(jnp.asarray([1.0, 1.0, 1.0, 0.3])))
    assert np.abs(bent - clear).mean() > 0.02


def test_the_renderers_own_gradient():
    found = built("bunny")
    assert found.native_ad is not None
    if not mitsuba.available(_mitsuba_ad.VARIANT):
        with pytest.raises(NotAble, match="libllvm"):
            found.native_ad()
        return
    value_and_grad = found.native_ad()
    y = found.reference + jnp.asarray([0.1, -0.1, 0.1])
    several = [value_and_grad(y + 1e-4 * i) for i in range(8)]
    loss, gradient = (np.mean([np.asarray(x[k]) for x in several], axis=0) for k in (0, 1))
    assert loss == pytest.approx(float(found.loss(y)), rel=0.2)
    for i, slope in enumerate(gradient):
        up, down = (found.exact_loss(with_entry(y, i, y[i] + h)) for h in (0.08, -0.08))
        assert slope == pytest.approx(float((up - down) / 0.16), rel=0.4)


def test_scenes_are_named_without_mitsuba():
    for name in HERE:
        spec = importlib.util.find_spec(tasks.SCENES[name])
        assert spec is not None
        assert tasks.module(name).TITLE
