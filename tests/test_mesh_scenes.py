"""Scenes of the mesh benchmarks: meshes, the renderer and its gradient, distances."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.scenes import meshes
from benchmarks.scenes.mesh_renderer import edges_of, render, views_around
from benchmarks.tasks import bunny, mesh_recovery


def draw(positions, faces, views):
    edges = edges_of(faces)
    return jax.jit(lambda x: render(x, faces, edges, views))(jnp.asarray(positions, jnp.float32))


MESHES = {
    "icosphere": meshes.icosphere(2),
    "cube": meshes.cube(5),
    "horned": meshes.horned(3),
    "spiral": meshes.ball(100),
    "bunny": bunny.body(),
}


@pytest.mark.parametrize("name", MESHES)
def test_meshes_are_closed_and_face_outwards(name):
    positions, faces = MESHES[name]
    edges = edges_of(faces)
    assert len(positions) - len(edges.ends) + len(faces) == 2  # Euler's formula of a ball
    assert np.unique(faces).tolist() == list(range(len(positions)))
    assert (np.linalg.det(positions[faces]) > 0).all()  # seen from the middle, each is in order
    shared = [len({*faces[one]} & {*faces[other]}) for one, other in edges.faces]
    assert set(shared) == {2}


def test_icospheres_have_as_many_vertices_as_they_say():
    for level in (0, 1, 3):
        positions, _ = meshes.icosphere(level)
        assert len(positions) == 10 * 4**level + 2
        np.testing.assert_allclose(np.linalg.norm(positions, axis=1), 1)


@pytest.mark.slow
def test_the_distances_are_zero_on_the_meshes_and_grow_as_one(x64):
    for distance, mesh in (
        (meshes.distance_to_cube, MESHES["cube"]),
        (meshes.distance_to_horned, MESHES["horned"]),
    ):
        positions = jnp.asarray(mesh[0])
        np.testing.assert_allclose(distance(positions), 0, atol=1e-5)
        away = jnp.asarray(3 * mesh[0] / np.linalg.norm(mesh[0], axis=1, keepdims=True))
        slope = jax.vmap(jax.grad(lambda p, d=distance: d(p[None])[0]))(away)
        length = jnp.linalg.norm(slope, axis=1)
        assert jnp.mean(jnp.abs(length - 1) < 1e-6) > 0.98  # it has kinks
    np.testing.assert_allclose(meshes.distance_to_horned(jnp.asarray(meshes.TIPS)), 0, atol=1e-12)


def test_a_ball_looks_like_a_disc():
    positions, faces = meshes.icosphere(3)
    views = views_around(3, 32, samples=4)
    picture = draw(positions, faces, views)
    y, x = np.mgrid[:32, :32] + 0.5 - 16
    from_middle = np.hypot(x, y) / 10  # the ball's radius is ten pixels
    assert picture.shape == (3, 32, 32, 3)
    assert jnp.all(picture[:, from_middle < 0.9] > 0.1)
    assert jnp.all(picture[:, from_middle > 1.1] == 0)
    covered = jnp.sum(jnp.minimum(picture.max(axis=-1) / 0.3, 1), axis=(1, 2))
    np.testing.assert_allclose(covered, np.pi * 100, rtol=0.05)


@pytest.mark.slow
def test_what_is_nearer_hides_what_is_behind():
    near, faces = meshes.icosphere(2)
    both = np.concatenate([0.4 * near, near])
    together = np.concatenate([faces, faces + len(near)])
    views = views_around(2, 24)
    hidden, alone = draw(both, together, views), draw(near, faces, views)
    np.testing.assert_allclose(hidden, alone, atol=1e-5)


def test_a_triangle_may_be_as_large_as_the_picture():
    corners = 4 * np.array([[1.0, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]])
    faces = np.array([[0, 1, 3], [0, 2, 1], [0, 3, 2], [1, 2, 3]])
    faces = faces if np.linalg.det(corners[faces])[0] > 0 else faces[:, ::-1]
    assert jnp.all(draw(corners, faces, views_around(4, 16)) > 0)


@pytest.mark.slow
def test_its_gradient_is_the_slope_of_a_supersampled_picture(x64):
    """On a ball; silhouettes are most of it. The random points are unbiased."""
    positions, faces = meshes.icosphere(2)
    edges, x = edges_of(faces), jnp.asarray(positions)
    row, column = np.mgrid[:16, :16] / 16
    waves = [np.sin(9 * column + c) * np.cos(7 * row - c) for c in range(3)]
    weight = jnp.asarray(np.stack(waves, axis=-1))[None]

    def value(x, samples, key=None):
        return jnp.sum(weight * render(x, faces, edges, views_around(2, 16, samples), key))

    fine = jax.jit(lambda x: value(x, 64))
    gradients = jax.jit(lambda keys: jax.lax.map(lambda k: jax.grad(value)(x, 2, k), keys))
    found = gradients(jax.random.split(jax.random.key(0), 500))
    for along in (
        positions,  # it grows,
        np.ones_like(positions) * [1, 0.5, -0.3],  # moves,
        positions * np.sin(4 * positions[:, :1] + 1),  # gets waves
    ):
        slope = (fine(x + 4e-3 * along) - fine(x - 4e-3 * along)) / 8e-3
        slopes = jnp.sum(found * along[None], axis=(1, 2))
        error = jnp.std(slopes) / np.sqrt(len(slopes))
        assert abs(jnp.mean(slopes) - slope) < 3 * error + 0.02 * abs(slope)


def test_without_silhouettes_it_would_be_far_off(x64):
    """A body of one colour changes only where its outline moves."""
    positions, faces = meshes.icosphere(2)
    edges, views = edges_of(faces), views_around(1, 16)
    area = lambda scale: jnp.sum(render(scale * jnp.asarray(positions), faces, edges, views))
    mean, slope = jax.jit(jax.value_and_grad(area))(jnp.array(1.0))
    # its normals stay as it grows, so the light of the ball grows with its area
    np.testing.assert_allclose(slope, 2 * mean, rtol=0.1)


def test_distances_to_triangles(x64):
    rng = np.random.default_rng(0)
    triangles, points = rng.standard_normal((7, 3, 3)), rng.standard_normal((20, 3))
    weights = np.stack(np.meshgrid(*2 * [np.linspace(0, 1, 150)]), axis=-1).reshape(-1, 2)
    weights = weights[weights.sum(axis=1) <= 1]
    weights = np.column_stack([weights, 1 - weights.sum(axis=1)])
    on_them = np.einsum("wk,tkc->twc", weights, triangles).reshape(-1, 3)
    nearest = np.linalg.norm(points[:, None] - on_them[None], axis=2).min(axis=1)
    found = jax.jit(mesh_recovery.squared_distances)(points, triangles)
    np.testing.assert_allclose(jnp.sqrt(found), nearest, atol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("build", [mesh_recovery.cube, mesh_recovery.horns])
def test_a_step_of_the_tasks_gets_closer(build):
    descent = build(False)
    start, scene = descent.start(0), descent.scene(0)
    errors = jax.jit(descent.score.errors)
    gradient = jax.jit(descent.problem.gradient)(start, jax.random.key(0), scene)
    assert [each.name for each in descent.configurations][:2] == [
        "laplacian-laplacian",
        "laplacian-bilateral",
    ]
    optimiser = descent.configurations[1].build(0.05, 0.9, 0.99)
    updates, _ = optimiser.update(gradient, optimiser.init(start), start)
    before, after = errors(start, scene), errors(start + updates, scene)
    assert after[descent.scored] < before[descent.scored]
