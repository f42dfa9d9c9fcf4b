"""Scenes with many parameters: references are minima, supports are right, grey boxes count."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from benchmarks import methods, tasks
from benchmarks._harness import Counter, _watched
from benchmarks._task import Budget, Grey, NotAble, Task
from benchmarks.methods import grey_box, grey_gauss_newton
from benchmarks.scenes import mesh_renderer, meshes, soft_mesh
from benchmarks.tasks import caustic, suzanne, texture32
from smoothdiff._support import as_support

SIZES = {"texture32": 1024, "caustic": 1024, "suzanne": 7686, "cnn": 267_745}
BUILT: dict[str, Task] = {}


def built(name: str) -> Task:
    """The task, built once."""
    return BUILT.setdefault(name, tasks.module(name).build(False))


@pytest.fixture(params=SIZES)
def task(request):
    return built(request.param)


def test_the_reference_is_the_minimum_and_starts_are_allowed(task):
    reference, _ = ravel_pytree(task.reference)
    low, high = (ravel_pytree(bound)[0] for bound in task.bounds)
    assert reference.size == SIZES[task.name]
    assert np.all((low < reference) & (reference < high))
    loss = jax.jit(task.exact_loss)  # a last layer alone does not fit all that is trained on
    lowest = float(loss(task.reference))
    for seed in range(2):
        y, _ = ravel_pytree(task.start(seed))
        assert y.dtype == reference.dtype == np.float32
        assert y.shape == reference.shape == low.shape == high.shape
        assert np.all((low <= y) & (y <= high))
        assert loss(task.start(seed)) > 30 * lowest + 1e-4


def test_the_usual_methods_of_a_large_scene_exist():
    for name in tasks.LARGE:
        assert set(tasks.module(name).METHODS) <= set(methods.METHODS)


def test_terms_add_up_to_the_loss():
    for name in ("texture32", "suzanne"):
        found = built(name)
        assert found.terms is not None
        y = found.start(1)
        assert float(jnp.sum(found.terms(y))) == pytest.approx(float(found.loss(y)), rel=1e-4)


def test_a_texel_changes_only_its_support():
    found = built("texture32")
    assert found.terms is not None
    assert found.support is not None
    terms, y = jax.jit(found.terms), found.start(0)
    before = terms(y)
    for texel in (0, 31, 300, 517, 992, 1023):
        changed = np.asarray(terms(y.at[texel].set(1 - y[texel])) != before)
        may = np.asarray(found.support(jnp.zeros_like(y).at[texel].set(1))) > 0
        assert changed.any()
        assert np.all(may[changed])
        assert may.sum() < 12
    assert 0.1 < texture32.texture().min() < texture32.texture().max() < 0.9


@pytest.mark.parametrize("moved", [False, True])
def test_where_a_vertex_is_seen_it_changes_most(moved):
    """Two fifths of it in 3 % of the tiles, before and after the body has moved."""
    found = built("suzanne")
    terms, support = found.terms, as_support(found.support)
    assert terms is not None
    assert support is not None
    terms, y = jax.jit(terms), found.start(0)
    if moved:
        y = {"positions": y["positions"] + found.reference["positions"]}
    around = jax.jit(lambda params: support.at(y)(params))
    before = terms(y)
    within, total, share = 0.0, 0.0, []
    for vertex in range(5, 2562, 400):
        one = jnp.zeros((2562, 3)).at[vertex].set(1)
        may = np.asarray(around({"positions": one})) > 0
        change = np.abs(
            np.asarray(terms({"positions": y["positions"] + 5 * found.sigma * one}) - before)
        )
        within, total = within + change[may].sum(), total + change.sum()
        share.append(may.mean())
    assert max(share) < 0.04
    assert within > 0.3 * total


@pytest.mark.parametrize("at", ["start", "reference"])
def test_light_falls_where_the_support_of_the_caustic_says(at):
    found = built("caustic")
    y = found.start(0) if at == "start" else found.reference
    assert found.terms is not None
    terms, blame = jax.jit(found.terms), as_support(found.support)
    assert blame is not None
    before, blame = terms(y), blame.at(y)
    within = total = 0.0
    for place in range(40, 1000, 97):
        one = jnp.zeros(1024).at[place].set(1).reshape(32, 32)
        change = np.abs(np.asarray(terms(y + 4 * found.sigma * one) - before))
        may = np.asarray(blame(one)) > 0
        within, total = within + change[may].sum(), total + change.sum()
        assert may.mean() < 0.02
    assert within > 0.9 * total


def test_coordinates_of_a_mesh_give_the_mesh(key):
    directions, faces = meshes.icosphere(2)
    positions = soft_mesh.Soft(0.8 * directions, faces)
    sought = suzanne.head(directions)
    assert np.asarray(positions(jnp.asarray(positions.coordinates(sought)))) == pytest.approx(
        sought, abs=1e-4
    )
    assert np.asarray(positions(jnp.zeros((162, 3)))) == pytest.approx(0.8 * directions, abs=1e-6)
    moved = positions(jax.random.normal(key, (162, 3))) - 0.8 * directions.astype(np.float32)
    assert float(jnp.std(moved)) == pytest.approx(1, rel=0.3)


def test_a_spiral_makes_a_closed_sphere_of_any_number_of_vertices():
    positions, faces = soft_mesh.ball(100)
    assert len(faces) == 2 * 100 - 4
    volume = np.sum(np.linalg.det(positions[faces])) / 6
    assert 0.9 < volume / (4 / 3 * np.pi) < 1


def test_a_look_is_the_picture_that_is_rendered():
    directions, faces = meshes.icosphere(2)
    positions = jnp.asarray(suzanne.head(directions), jnp.float32)
    views = mesh_renderer.views_around(2, 12)
    seen = jax.jit(lambda x: mesh_renderer.look(x, faces, views))
    edges = mesh_renderer.edges_of(faces)
    rendered = jax.jit(lambda x: mesh_renderer.render(x, faces, edges, views))
    assert np.asarray(seen(positions)) == pytest.approx(np.asarray(rendered(positions)), abs=1e-5)
    many = jax.jit(jax.vmap(lambda x: mesh_renderer.look(x, faces, views)))
    assert np.array_equal(many(jnp.stack([positions] * 2))[1], seen(positions))


def test_light_goes_straight_down_through_flat_glass_and_is_focused_by_a_ridge():
    flat = jnp.zeros((32, 32))
    assert np.array_equal(caustic.draw(flat, 64, 16), np.ones((16, 16)))
    assert np.asarray(caustic.draw(flat + 1, 64, 16)) == pytest.approx(1)
    face = jnp.asarray(caustic.face(), jnp.float32)
    picture = np.asarray(caustic.draw(face, 256, 64))
    assert picture.mean() == pytest.approx(1, abs=0.01)
    # the eyes are lenses, a third of the way from the middle
    assert picture[24:27, 22:25].max() > 4
    assert picture[24:27, 39:42].max() > 4


def test_light_is_bent_as_snell_says():
    slope = 0.2
    ramp = jnp.tile(jnp.arange(32.0) * slope / caustic.HEIGHT / 29, (32, 1))
    x, y = np.asarray(caustic.land(ramp, (np.arange(8) + 0.5) / 8))
    middles = (np.arange(8) + 0.5) / 8
    angle = np.arctan(slope)
    bend = np.arcsin(caustic.INDEX * np.sin(angle)) - angle
    height = slope * (middles + 1 / 29)  # the first spline is at -1 / 29
    assert x == pytest.approx(np.tile(middles + np.tan(bend) * (1 - height), (8, 1)), abs=0.01)
    assert y == pytest.approx(np.tile(middles[:, None], (1, 8)), abs=1e-6)


def test_the_caustic_has_no_slope_that_ad_could_use():
    found = built("caustic")
    y = found.start(0)
    loss = jax.jit(jax.vmap(found.loss))
    tiny = 1e-7 * jax.random.normal(jax.random.key(0), (4, *y.shape))
    assert np.mean(np.asarray(loss(y[None] + tiny)) == loss(y[None])) > 0.5


def linear_grey(sigma: float = 0.5) -> Task:
    """A network without hidden layers, which says what was drawn from pictures of four pixels."""
    drawing = jnp.array([[1.0, -2.0], [0.5, 0.3], [0.2, 0.4], [-1.0, 0.1]])
    cases = jax.random.normal(jax.random.key(1), (16, 2)) @ drawing.T
    weights = jnp.linalg.pinv(drawing)

    def render(x):
        return (drawing @ x).reshape(2, 2, 1)

    def white(y, case):
        return y.reshape(2, 4) @ case.ravel()

    grey = Grey(white, render, cases.reshape(-1, 2, 2, 1), sigma)
    reference = weights.ravel()
    return Task(
        name="linear",
        title="",
        loss=grey.loss,
        exact_loss=grey.loss,
        start=lambda seed: jnp.zeros(8),
        reference=reference,
        bounds=(reference - 9, reference + 9),
        sigma=sigma,
        budget=Budget(10_000, 60),
        seeds=1,
        grey=grey,
    )


def test_renders_are_counted_in_grey_boxes():
    counter = Counter()
    task = _watched(linear_grey(), counter)
    jax.block_until_ready(jax.jit(task.loss)(task.start(0)))
    assert counter.evaluations == 16


@pytest.fixture
def standard_promotion():
    """optax's own Adam does not run under strict promotion."""
    with jax.numpy_dtype_promotion("standard"):
        yield


class Done(Exception):
    """Ends a method."""


def trained(prepare, rate: tuple, monkeypatch, task: Task | None = None) -> tuple[Task, list, int]:
    """A task, the weights after each step, and evaluations a step."""
    monkeypatch.setattr(*rate)
    counter = Counter()
    task = dataclasses.replace(task or linear_grey(), budget=Budget(8 * 4 * 150, 60))
    found = []

    def record(y):
        found.append(np.asarray(y))
        if counter.evaluations >= task.budget.evaluations:
            raise Done

    with pytest.raises(Done):
        prepare(_watched(task, counter))(task.start(0), jax.random.key(0), record)
    assert counter.evaluations % len(found) == 0
    return task, found, counter.evaluations // len(found)


@pytest.mark.parametrize("name", grey_box.VARIANTS)
def test_grey_boxes_train_a_network(name, monkeypatch, standard_promotion):
    title, prepare = grey_box.VARIANTS[name]
    task, found, per_step = trained(prepare, (grey_box, "RATE", 0.05), monkeypatch)
    assert per_step in (8 * 2, 8 * 4)
    assert task.loss(found[-1]) < 0.05 * task.loss(task.start(0))
    assert title


def test_gauss_newton_finds_what_a_network_is_to_answer(monkeypatch, standard_promotion):
    monkeypatch.setattr(grey_gauss_newton, "LESSONS", (8, 24))
    task, found, per_step = trained(
        grey_gauss_newton.prepare, (grey_gauss_newton, "RATE", 0.05), monkeypatch
    )
    # all cases at once; a step of each, two to choose between the network and the solver, and as
    # many that are there to be learnt from
    assert per_step == 16 * 2 * (6 + 2)
    assert task.loss(found[-1]) < 1e-4 * task.loss(task.start(0))


def test_cases_learn_from_each_other_and_not_from_renders_that_failed(
    monkeypatch, standard_promotion
):
    """A renderer that fails in a corner of its parameters, in which no picture is."""
    monkeypatch.setattr(grey_gauss_newton, "LESSONS", (8, 24))
    task = linear_grey()
    assert task.grey is not None
    draw = task.grey.render
    failed = []

    def fails(x):
        bad = x[0] > 2.2
        jax.debug.callback(lambda bad: failed.append(bool(bad)), bad)
        return jnp.where(bad, jnp.nan, draw(x))

    grey = task.grey._replace(render=fails)
    task = dataclasses.replace(task, grey=grey, loss=grey.loss)
    # one case has a step at a time, and the others see what was rendered for it
    monkeypatch.setattr(grey_gauss_newton, "CASES", 1)
    # fewer renders are kept than made
    monkeypatch.setattr(grey_gauss_newton, "KEPT", 512)
    task, found, per_step = trained(
        grey_gauss_newton.prepare, (grey_gauss_newton, "RATE", 0.05), monkeypatch, task
    )
    assert per_step == 2 * (6 + 2)
    jax.effects_barrier()
    assert any(failed)
    assert np.isfinite(found).all()
    # each case has had two steps when all have learned from 32 of them
    assert task.loss(found[2 * 16 - 1]) < 0.2 * task.loss(task.start(0))


def test_new_poses_are_spread_like_those_found(key):
    scale = jnp.array([1.0, 20.0, 0.0])
    found = scale[None] * jax.random.uniform(key, (256, 3)) + 5
    poses = grey_gauss_newton._like(jax.random.key(1), found, (40, 50)).reshape(-1, 3)
    assert (poses >= found.min(0)[None]).all()
    assert (poses <= found.max(0)[None]).all()
    np.testing.assert_allclose(poses.std(0), found.std(0), rtol=0.15)
    # hardly any is one of those found
    assert len(np.unique(poses[:, 0])) > 1500


@pytest.mark.parametrize("prepare", [grey_box.VARIANTS["grey_fr22"][1], grey_gauss_newton.prepare])
def test_grey_boxes_need_a_part_that_ad_knows(prepare):
    with pytest.raises(NotAble, match="AD"):
        prepare(built("caustic"))


def test_poses_and_not_weights_are_what_a_network_is_judged_by():
    found = built("cnn")
    assert found.distance is not None
    assert float(found.distance(found.reference)) < 0.01
    assert float(found.distance(found.start(0))) > 0.8
    assert found.image is not None
    assert found.image(found.reference).shape == (32, 32 * 6, 3)
