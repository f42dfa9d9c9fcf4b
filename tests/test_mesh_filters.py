"""Filters on meshes: against dense matrices and the equations, invariants, limits, bad input."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import assert_same

from benchmarks.scenes.meshes import cube, icosphere
from smoothdiff.filters import mesh
from smoothdiff.filters._triangles import edges
from smoothdiff.filters.mesh import mesh_bilateral, mesh_laplacian
from tests.parts import quick_of

LAM = 19.0  # the paper's
SIGMAS: Any = {"sigma_d": 0.5, "sigma_phi": 0.4}


def strip(length):
    """A flat band of triangles, open at its borders."""
    i = np.arange(length)
    faces = np.stack([i, i + 1, i + 2], axis=1)
    faces[1::2] = faces[1::2, ::-1]
    k = np.arange(length + 2)
    return np.stack([k / 2, (k % 2) * 0.9, 0.0 * k], axis=1), faces


def apart():
    """Two bodies, and a vertex that has no face."""
    (one, faces), (other, more) = icosphere(1), cube(2)
    return np.concatenate([one, other + 3, [[9.0, 9, 9]]]), np.concatenate([faces, more + len(one)])


MESHES = {
    "ball": icosphere(2),
    "cube": cube(6),
    "band": strip(40),
    "triangle": strip(1),
    "apart": apart(),
}


@pytest.fixture(params=quick_of(MESHES, ["cube", "apart"]))
def body(request):
    positions, faces = MESHES[request.param]
    rng = np.random.default_rng(3)
    return positions + 0.02 * rng.standard_normal(positions.shape), faces


def noise(positions, channels=2):
    return np.random.default_rng(0).standard_normal((len(positions), channels))


def dense_laplacian(positions, faces, weights):
    """L, triangle by triangle, angle by angle."""
    matrix = np.zeros((len(positions), len(positions)))
    for face in faces:
        for i, j, k in (face, np.roll(face, 1), np.roll(face, 2)):
            u, v = positions[j] - positions[i], positions[k] - positions[i]
            if weights == "cotangent":
                matrix[[j, k], [k, j]] -= u @ v / np.linalg.norm(np.cross(u, v)) / 2
            else:
                matrix[[j, k], [k, j]] = -1
    return matrix - np.diag(matrix.sum(axis=1))


def dense_filter(positions, faces, lam, weights="uniform"):
    n = len(positions)
    return np.linalg.inv(np.eye(n) + lam * dense_laplacian(positions, faces, weights))


def normals_of(positions, faces):
    total = np.zeros_like(positions)
    for face in faces:
        a, b, c = positions[face]
        total[face] += np.cross(b - a, c - a)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return total / np.where(length > 0, length, 1)


@pytest.mark.parametrize("weights", ["uniform", "cotangent"])
@pytest.mark.parametrize("lam", [0.0, 100.0])
def test_laplacian_is_the_inverse_of_the_dense_matrix(body, weights, lam, dtype):
    positions, faces = body
    signal = noise(positions)
    smooth = jax.jit(mesh_laplacian(faces, lam, weights=weights))
    smoothed = smooth(jnp.asarray(signal, dtype), jnp.asarray(positions, dtype))
    expected = dense_filter(positions, faces, lam, weights) @ signal
    assert smoothed.dtype == dtype
    tolerance = 2e-6 if dtype == jnp.float32 else 1e-7 if weights == "cotangent" else 1e-12
    np.testing.assert_allclose(smoothed, expected, rtol=0, atol=tolerance)


def test_power_is_applying_it_again(body, x64):
    positions, faces = body
    once, twice = mesh_laplacian(faces, LAM), mesh_laplacian(faces, LAM, power=2.0)

    @jax.jit
    def both(signal):
        return twice(signal, None), once(once(signal, None), None)

    found, again = both(noise(positions))
    assert_same(found, again, jnp.float64)


@pytest.mark.parametrize("weights", ["uniform", "cotangent"])
def test_the_size_of_a_signal_does_not_matter(weights):
    """Nor that of the other channels: the second moment of a small gradient is tiny."""
    positions, faces = icosphere(2)
    guide = jnp.asarray(positions, jnp.float32)
    smooth = jax.jit(mesh_laplacian(faces, LAM, weights=weights))
    signal = jnp.asarray(noise(positions), jnp.float32)[:, :1]
    expected = smooth(signal, guide)[:, 0]
    scales = jnp.array([1e-25, 1e-18, 1e-13, 1e-6, 1.0, 1e18, 1e30], jnp.float32)
    found = smooth(signal * scales[None], guide) / scales[None]
    for column in found.T:
        np.testing.assert_allclose(column, expected, rtol=1e-4, atol=1e-6)
    half = smooth(signal.astype(jnp.float16), guide.astype(jnp.float16))
    assert half.dtype == jnp.float16
    np.testing.assert_allclose(half[:, 0].astype(jnp.float32), expected, atol=5e-3)


def test_a_signal_may_be_numpys():
    positions, faces = MESHES["triangle"]
    smooth = mesh_laplacian(faces, LAM)
    signal: Any = np.float32(noise(positions))
    np.testing.assert_array_equal(smooth(signal, None), smooth(jnp.asarray(signal), None))


def test_it_is_accurate_on_a_mesh_of_many_parts(key):
    positions, faces = icosphere(4)
    smooth = jax.jit(mesh_laplacian(faces, LAM))
    with jax.enable_x64(True):
        signal = np.asarray(jax.random.normal(key, (len(positions), 3), jnp.float64))
        smoothed = np.asarray(smooth(signal, None))
    ends, _ = edges(faces)
    difference = smoothed[ends[0]] - smoothed[ends[1]]
    back = smoothed.copy()
    np.add.at(back, ends[0], LAM * difference)
    np.add.at(back, ends[1], -LAM * difference)
    np.testing.assert_allclose(back, signal, atol=1e-11)
    single = smooth(np.float32(signal), None)
    np.testing.assert_allclose(single, smoothed, atol=1e-6)


@pytest.mark.parametrize("weights", quick_of(["uniform", "cotangent"], ["cotangent"]))
def test_laplacian_is_linear_symmetric_and_differentiable(weights, x64):
    positions, faces = MESHES["cube"]
    smooth = mesh_laplacian(faces, LAM, weights=weights)

    @jax.jit
    def run(a, b, guide):
        of_guide = lambda signal: smooth(signal, guide)
        return of_guide(b), jax.vjp(of_guide, a)[1](b)[0], jax.jvp(of_guide, (a,), (b,))[1]

    smoothed, pulled, moved = run(noise(positions, 3), positions**2, positions)
    np.testing.assert_allclose(pulled, smoothed, atol=1e-7)  # its own transpose
    np.testing.assert_allclose(moved, smoothed, atol=1e-7)


def test_filters_are_differentiable_in_the_guide(x64):
    positions, faces = MESHES["cube"]
    signal: Any = noise(positions)
    guide, direction = positions, noise(positions, 3)
    for smooth in (
        mesh_laplacian(faces, 1.0, weights="cotangent"),
        mesh_bilateral(faces, LAM, **SIGMAS),
    ):
        value = jax.jit(lambda guide, smooth=smooth: jnp.sum(smooth(signal, guide) ** 2))
        ahead, behind = (float(value(guide + h * direction)) for h in (1e-4, -1e-4))
        slope = np.vdot(jax.jit(jax.grad(value))(guide), direction)
        np.testing.assert_allclose(slope, (ahead - behind) / 2e-4, rtol=1e-4)


@pytest.mark.parametrize("make", [mesh_laplacian, mesh_bilateral], ids=["laplacian", "bilateral"])
def test_jit_and_vmap_change_nothing(make, key):
    positions, faces = MESHES["ball"]
    smooth = make(faces, LAM) if make is mesh_laplacian else make(faces, LAM, **SIGMAS)
    guide = np.float32(positions)
    signals = np.asarray(jax.random.normal(key, (3, len(positions), 2)))
    together = np.asarray(jax.jit(jax.vmap(smooth, in_axes=(0, None)))(signals, guide))
    for signal, one in zip(signals, together, strict=True):
        np.testing.assert_allclose(one, smooth(jnp.asarray(signal), guide), atol=2e-6)


@pytest.mark.parametrize("sigma_d", [0.05, 0.5, 5.0])
def test_bilateral_is_equation_5(body, sigma_d, dtype):
    positions, faces = body
    signal = noise(positions)
    smooth = jax.jit(mesh_bilateral(faces, LAM, sigma_d, 0.4, num_directions=8))
    smoothed = smooth(jnp.asarray(signal, dtype), jnp.asarray(positions, dtype))
    matrix, normals = dense_filter(positions, faces, LAM), normals_of(positions, faces)
    above = below = 0
    for direction in mesh._sphere_points(8):
        cosine = (normals @ direction)[:, None]
        phi, w = np.exp(cosine / 0.4), np.exp(cosine / sigma_d)
        above, below = above + phi * (matrix @ (w * signal)), below + phi * (matrix @ w)
    assert smoothed.dtype == dtype
    tolerance = 2e-3 if sigma_d < 0.1 else 2e-5
    if dtype == jnp.float64:
        tolerance = 1e-9 if sigma_d < 0.1 else 1e-11
    np.testing.assert_allclose(smoothed, above / below, rtol=0, atol=tolerance)


def test_a_wide_data_term_leaves_the_laplacian(body, dtype):
    positions, faces = body
    signal, guide = np.asarray(noise(positions), dtype), np.asarray(positions, dtype)
    expected = jax.jit(mesh_laplacian(faces, LAM))(signal, guide)
    for sigma_d in (1e9, np.inf):
        smoothed = jax.jit(mesh_bilateral(faces, LAM, sigma_d, 0.4))(signal, guide)
        np.testing.assert_allclose(smoothed, expected, atol=2e-5)


def test_a_narrow_data_term_is_the_identity_where_normals_vary(dtype):
    positions, faces = MESHES["ball"]
    signal, guide = np.asarray(noise(positions), dtype), np.asarray(positions, dtype)
    for sigma_d in (1e-9, 1e-30):
        smoothed = jax.jit(mesh_bilateral(faces, LAM, sigma_d, 0.4))(signal, guide)
        np.testing.assert_array_equal(smoothed, signal)


def test_bilateral_keeps_what_is_constant_and_stays_between_the_extremes(body, dtype):
    positions, faces = body
    guide = np.asarray(positions, dtype)
    step = np.asarray(positions[:, :1] > 0, dtype)
    for sigma_d in (1e-3, 0.02, 0.5, 10.0):
        smooth = jax.jit(mesh_bilateral(faces, LAM, sigma_d, 0.4))
        np.testing.assert_allclose(smooth(0 * step + 7, guide), 7, rtol=1e-5)
        smoothed = np.asarray(smooth(step, guide))
        assert np.all(np.isfinite(smoothed))
        # the sums of the smallest weights are as large as what rounding leaves of others
        margin = 0.5 if dtype == jnp.float32 and sigma_d < 0.1 else 1e-4
        assert np.all((smoothed >= -margin) & (smoothed <= 1 + margin))


@pytest.mark.slow
def test_bilateral_keeps_a_crease_that_the_laplacian_washes_out():
    positions, faces = cube(16)
    guide = np.float32(positions)
    top = positions[:, 2] > positions[:, 2].max() - 1e-6
    inner = top & (np.abs(positions[:, :2]).max(axis=1) < positions.max() - 1e-6)
    signal = np.float32(inner[:, None])  # a gradient that lifts the top
    at_rim = inner & (np.abs(positions[:, :2]).max(axis=1) > 0.85 * positions.max())
    below = (np.abs(positions[:, 2] - 0.85 * positions.max()) < 0.05) & ~top

    def contrast(smooth):
        smoothed = np.asarray(jax.jit(smooth)(signal, guide))
        return np.mean(smoothed[at_rim]) - np.mean(smoothed[below])

    plain = contrast(mesh_laplacian(faces, LAM))
    assert contrast(mesh_bilateral(faces, LAM, **SIGMAS)) > 2 * plain


def test_degenerate_triangles_and_hard_scales_give_numbers(dtype):
    positions, faces = MESHES["cube"]
    faces = np.concatenate([faces, [[0, 0, 1], [2, 2, 2]]])
    signal: Any = np.asarray(noise(positions), dtype)
    flat, point = positions * [1, 1, 0], 0 * positions
    line = positions * [1, 0, 0]
    both = [
        jax.jit(jax.value_and_grad(lambda guide, f=f: jnp.sum(f(signal, guide) ** 2)))
        for f in (
            mesh_laplacian(faces, LAM, weights="cotangent"),
            mesh_bilateral(faces, LAM, **SIGMAS),
        )
    ]
    for guide in (flat, line, point, 1e-30 * positions, 1e30 * positions, positions + 1e4):
        for smooth in both:
            value, gradient = smooth(np.asarray(guide, dtype))
            assert np.all(np.isfinite(value))
            assert np.all(np.isfinite(gradient))


def test_the_scales_may_be_traced():
    positions, faces = MESHES["cube"]
    signal: Any = np.float32(noise(positions))
    guide: Any = np.float32(positions)
    traced = jax.jit(lambda d, phi: mesh_bilateral(faces, LAM, d, phi)(signal, guide))
    expected = jax.jit(mesh_bilateral(faces, LAM, **SIGMAS))(signal, guide)
    np.testing.assert_allclose(traced(0.5, 0.4), expected, atol=1e-5)


@pytest.mark.parametrize("number", [1, 7, 32])
def test_directions_are_spread_over_the_sphere(number):
    directions = mesh._sphere_points(number)
    assert directions.shape == (number, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    if number == 32:
        np.testing.assert_allclose(directions.mean(axis=0), 0, atol=0.02)


@pytest.mark.parametrize(
    ("faces", "says"),
    [
        ([0, 1, 2], r"shape \(faces, 3\)"),
        ([[0, 1, 2, 3]], "cut other polygons"),
        (np.zeros((0, 3), int), r"shape \(faces, 3\)"),
        ([[0.0, 1.0, 2.0]], "astype"),
        ([[0, 1, -1]], "from 0"),
        ([[1, 1, 2]], "three different vertices"),
    ],
)
@pytest.mark.parametrize("make", [mesh_laplacian, mesh_bilateral], ids=["laplacian", "bilateral"])
def test_bad_faces_are_refused(make, faces, says):
    with pytest.raises(ValueError, match=says):
        make(faces, 1.0, **({} if make is mesh_laplacian else SIGMAS))


def test_faces_of_another_mesh_are_refused():
    with pytest.raises(ValueError, match="index 9, but there are 4 vertices"):
        mesh_laplacian([[0, 1, 9]], 1.0)(jnp.zeros((4, 3)), None)


def test_traced_faces_are_refused():
    with pytest.raises(ValueError, match="static_args"):
        jax.jit(lambda faces: mesh_laplacian(faces, 1.0)(jnp.zeros((3, 1)), None))(
            jnp.array([[0, 1, 2]])
        )


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"lam": -1.0}, "lam"),
        ({"lam": np.inf}, "lam"),
        ({"lam": np.nan}, "lam"),
        ({"lam": 1e16}, "mean of each connected part"),
        ({"lam": 1.0, "power": 0}, "power"),
        ({"lam": 1.0, "weights": "mean"}, "cotangent"),
    ],
)
def test_bad_options_of_the_laplacian_are_refused(options, says):
    with pytest.raises(ValueError, match=says):
        mesh_laplacian([[0, 1, 2]], **options)


def test_the_largest_lambda_is_the_mean_of_each_connected_part(dtype):
    positions, faces = MESHES["apart"]
    signal = noise(positions).astype(dtype)
    one = len(icosphere(1)[0])
    means = [np.broadcast_to(part.mean(0), part.shape) for part in (signal[:one], signal[one:-1])]
    expected = np.concatenate([*means, signal[-1:]])
    found = mesh_laplacian(faces, mesh.MOST_LAM)(jnp.asarray(signal), None)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    cotangent = mesh_laplacian(faces, mesh.MOST_LAM, weights="cotangent")
    found = cotangent(jnp.asarray(signal), positions)
    np.testing.assert_allclose(found, expected, atol=2e-3)


@pytest.mark.parametrize("bad", [{"sigma_d": 0.0}, {"sigma_phi": -1.0}, {"num_directions": 0}])
def test_bad_options_of_the_bilateral_are_refused(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        mesh_bilateral([[0, 1, 2]], 1.0, **(SIGMAS | bad))


def test_signals_and_guides_of_the_wrong_shape_are_refused():
    smooth = mesh_bilateral([[0, 1, 2]], 1.0, **SIGMAS)
    with pytest.raises(ValueError, match=r"signal\[:, None\]"):
        smooth(jnp.zeros(3), jnp.zeros((3, 3)))
    with pytest.raises(ValueError, match="positions"):
        smooth(jnp.zeros((3, 1)), jnp.zeros((3, 2)))
    with pytest.raises(ValueError, match="positions"):
        mesh_laplacian([[0, 1, 2]], 1.0, weights="cotangent")(jnp.zeros((3, 1)), None)


def test_whole_numbers_are_filtered_as_floats():
    tetrahedron = [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]
    found = mesh_laplacian(tetrahedron, 19.0)(jnp.full((4, 1), 5), None)
    np.testing.assert_allclose(found, 5.0, rtol=1e-5)
