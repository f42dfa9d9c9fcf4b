"""Scenes with many parameters: references are minima, and supports are right."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from benchmarks import _registry
from benchmarks._task import Task
from benchmarks.scenes import mesh_renderer, meshes
from benchmarks.tasks import caustic, soft_meshes, texture32
from smoothdiff._support import as_support

SIZES = {"texture32": 1024, "caustic": 1024, "suzanne": 7686, "cnn": 267_745}


@cache
def built(name: str) -> Task:
    """The task, built once."""
    task = _registry.task(name).build(False)
    assert isinstance(task, Task)
    return task


@pytest.mark.parametrize(
    "name",
    [
        "texture32",
        "caustic",
        *(pytest.param(n, marks=pytest.mark.slow) for n in ("suzanne", "cnn")),
    ],
)
def test_the_reference_is_the_minimum_and_starts_are_allowed(name):
    task = built(name)
    reference, low, high = (
        np.asarray(ravel_pytree(y)[0]) for y in (task.score.reference, *task.problem.bounds)
    )
    assert reference.size == SIZES[name]
    assert np.all((low < reference) & (reference < high))
    loss = jax.jit(task.exact_loss)  # a last layer alone does not fit all that is trained on
    lowest = float(loss(task.score.reference))
    for seed in range(2):
        y = np.asarray(ravel_pytree(task.start(seed))[0])
        assert y.dtype == reference.dtype == np.float32
        assert y.shape == reference.shape == low.shape == high.shape
        assert np.all((low <= y) & (y <= high))
        assert loss(task.start(seed)) > 30 * lowest + 1e-4
    if (terms := task.problem.terms) is not None:
        total, loss = jax.jit(lambda y: (jnp.sum(terms(y)), task.problem.loss(y)))(task.start(1))
        assert total == pytest.approx(float(loss), rel=1e-4)


def share_within(name: str, y, moves, most: float) -> float:
    """How much of what moves change is where the support says, of which no share is above `most`.

    A move is where, like y, and how far.
    """
    problem = built(name).problem
    support = as_support(problem.support)
    assert problem.terms is not None
    assert support is not None
    terms, around = jax.jit(problem.terms), jax.jit(lambda params: support.at(y)(params))
    before, within, total = terms(y), 0.0, 0.0
    for one, far in moves:
        moved = jax.tree.map(lambda y, one, far=far: y + far * one, y, one)
        change = np.abs(np.asarray(terms(moved) - before))
        may = np.asarray(around(one)) > 0
        assert change.any()
        assert may.mean() < most
        within, total = within + change[may].sum(), total + change.sum()
    return within / total


def test_a_texel_changes_only_its_support():
    y = np.asarray(built("texture32").start(0))
    moves = [
        (np.float32(np.arange(1024) == texel), 1 - 2 * y[texel])
        for texel in (0, 31, 300, 517, 992, 1023)
    ]
    assert share_within("texture32", y, moves, 12 / 48**2) == pytest.approx(1, abs=1e-6)
    assert 0.1 < texture32.texture().min() < texture32.texture().max() < 0.9


@pytest.mark.slow
@pytest.mark.parametrize("at", ["start", "reference"])
def test_light_falls_where_the_support_of_the_caustic_says(at):
    y = built("caustic").start(0) if at == "start" else built("caustic").score.reference
    far = 4 * caustic.SIGMA
    moves = [
        (np.float32(np.arange(1024) == place).reshape(32, 32), far) for place in range(40, 1000, 97)
    ]
    assert share_within("caustic", y, moves, 0.02) > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("moved", [False, True])
def test_where_a_vertex_is_seen_it_changes_most(moved):
    """Two fifths of it in 3 % of the tiles, before and after the body has moved."""
    y = built("suzanne").start(0)
    if moved:
        y = jax.tree.map(jnp.add, y, built("suzanne").score.reference)
    far = 5 * soft_meshes.SIGMA
    moves = [
        ({"positions": jnp.zeros((2562, 3)).at[vertex].set(1)}, far)
        for vertex in range(5, 2562, 400)
    ]
    assert share_within("suzanne", y, moves, 0.04) > 0.3


def test_coordinates_of_a_mesh_give_the_mesh(key):
    directions, faces = meshes.icosphere(2)
    positions = soft_meshes.Soft(0.8 * directions, faces)
    sought = soft_meshes.head(directions)
    at = jax.jit(lambda coordinates: positions(coordinates))
    found = np.asarray(at(positions.coordinates(sought)))
    assert found == pytest.approx(sought, abs=1e-4)
    unmoved = np.asarray(at(np.zeros((162, 3), np.float32)))
    assert unmoved == pytest.approx(0.8 * directions, abs=1e-6)
    moved = np.asarray(at(jax.random.normal(key, (162, 3)))) - 0.8 * directions
    assert np.std(moved) == pytest.approx(1, rel=0.3)


@pytest.mark.slow
def test_a_look_is_the_picture_that_is_rendered():
    directions, faces = meshes.icosphere(2)
    positions = jnp.asarray(soft_meshes.head(directions), jnp.float32)
    views = mesh_renderer.views_around(2, 12)
    seen = jax.jit(lambda x: mesh_renderer.look(x, faces, views))
    edges = mesh_renderer.edges_of(faces)
    rendered = jax.jit(lambda x: mesh_renderer.render(x, faces, edges, views))
    assert np.asarray(seen(positions)) == pytest.approx(np.asarray(rendered(positions)), abs=1e-5)
    many = jax.jit(jax.vmap(seen))
    assert np.array_equal(many(jnp.stack([positions] * 2))[1], seen(positions))


def test_light_goes_straight_down_through_flat_glass_and_is_focused_by_a_ridge():
    draw = jax.jit(caustic.draw, static_argnums=(1, 2))
    flat = np.zeros((32, 32), np.float32)
    assert np.array_equal(draw(flat, 64, 16), np.ones((16, 16)))
    assert np.asarray(draw(flat + 1, 64, 16)) == pytest.approx(1)
    picture = np.asarray(draw(np.float32(caustic.face()), 256, 64))
    assert picture.mean() == pytest.approx(1, abs=0.01)
    # the eyes are lenses, a third of the way from the middle
    assert picture[24:27, 22:25].max() > 4
    assert picture[24:27, 39:42].max() > 4


def test_light_is_bent_as_snell_says():
    slope = 0.2
    ramp = np.float32(np.tile(np.arange(32) * slope / caustic.HEIGHT / 29, (32, 1)))
    middles = (np.arange(8) + 0.5) / 8
    x, y = np.asarray(jax.jit(lambda ramp: caustic.land(ramp, middles))(ramp))
    angle = np.arctan(slope)
    bend = np.arcsin(caustic.INDEX * np.sin(angle)) - angle
    height = slope * (middles + 1 / 29)  # the first spline is at -1 / 29
    assert x == pytest.approx(np.tile(middles + np.tan(bend) * (1 - height), (8, 1)), abs=0.01)
    assert y == pytest.approx(np.tile(middles[:, None], (1, 8)), abs=1e-6)


def test_the_caustic_has_no_slope_that_ad_could_use():
    y = built("caustic").start(0)
    loss = jax.jit(built("caustic").problem.loss)
    tiny = 1e-7 * jax.random.normal(jax.random.key(0), (4, *y.shape))
    assert np.mean([loss(y + move) == loss(y) for move in tiny]) > 0.5


@pytest.mark.slow
def test_poses_and_not_weights_are_what_a_network_is_judged_by():
    task = built("cnn")
    reference, distance, image = task.score.reference, task.score.distance, task.score.image
    assert distance is not None
    assert float(distance(reference)) < 0.01
    assert float(distance(task.start(0))) > 0.8
    assert image is not None
    assert image(reference).shape == (32, 32 * 6, 3)
