"""Filters on grids: the paper's equation by brute force, dense matrices, limits, extremes."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.test_util import check_grads

import smoothdiff as sd
from smoothdiff.filters import bilateral, cross_bilateral, laplacian

SHAPES = [(9,), (5, 6), (3, 4, 5), (1, 5), (1, 1, 1)]
FILTERS = {
    "cross_bilateral": lambda ndim: cross_bilateral(0.7, 3, ndim=ndim),
    "bilateral": lambda ndim: bilateral(0.7, 3, ndim=ndim),
    "laplacian": lambda ndim: laplacian(2.0, ndim=ndim),
}


@functools.cache
def compiled(name, ndim):
    """One program for all tests of a filter on so many axes."""
    return jax.jit(FILTERS[name](ndim))


def random(*shape, dtype=np.float32, seed=0):
    return np.random.default_rng(seed).normal(size=shape).astype(dtype)


def brute_force(signal, guide, sigma_d, levels, sigma_s):
    """Equations 3 and 4, tap by tap, on (*space, channels)."""
    space = signal.shape[:-1]
    for level in range(levels):
        smooth = np.zeros_like(signal)
        for x in np.ndindex(*space):
            total, weights = 0.0, 0.0
            for tap in itertools.product((-1, 0, 1), repeat=len(space)):
                y = tuple(i + 2**level * k for i, k in zip(x, tap, strict=True))
                if all(0 <= i < n for i, n in zip(y, space, strict=True)):
                    near = np.exp(-np.linalg.norm(tap) / sigma_s)
                    weight = near * np.exp(-np.linalg.norm(guide[y] - guide[x]) / sigma_d)
                    total, weights = total + weight * signal[y], weights + weight
            smooth[x] = total / weights
        signal = smooth
    return signal


def matrix(filter, guide):
    """The filter of signals without channels as a dense matrix."""
    n = guide.size
    rows = jax.jit(jax.vmap(filter, (0, None)))(
        np.eye(n, dtype=guide.dtype).reshape(n, *guide.shape), guide
    )
    return np.asarray(rows, np.float64).reshape(n, n).T


def dense_laplacian(space):
    total = np.zeros((np.prod(space),) * 2)
    for axis, n in enumerate(space):
        steps = np.diff(np.eye(n), axis=0)
        parts = [np.eye(m) for m in space]
        parts[axis] = steps.T @ steps
        product = np.ones((1, 1))
        for part in parts:
            product = np.kron(product, part)
        total += product
    return total


@pytest.mark.parametrize("space", SHAPES)
@pytest.mark.parametrize("channels", [1, 3])
def test_cross_bilateral_is_equation_3(space, channels, dtype):
    signal, guide = random(*space, 2, dtype=dtype), random(*space, channels, dtype=dtype, seed=1)
    levels = 3 if len(space) < 3 else 2
    found = jax.jit(cross_bilateral(0.7, levels, ndim=len(space), sigma_s=1.3))(signal, guide)
    expected = brute_force(np.float64(signal), np.float64(guide), 0.7, levels, 1.3)
    assert found.dtype == dtype
    np.testing.assert_allclose(found, expected, atol=20 * float(jnp.finfo(dtype).eps), rtol=0)


def test_log_takes_the_logarithm_of_the_guide():
    signal, guide = random(6, 5), random(6, 5, seed=1)
    found = jax.jit(cross_bilateral(0.5, 2, ndim=2, log=True))(signal, guide)
    expected = jax.jit(cross_bilateral(0.5, 2, ndim=2))(signal, np.log(np.abs(guide)))
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_bilateral_is_guided_by_the_signal():
    signal, guide = random(6, 5, 2), random(6, 5, 1, seed=1)
    found = jax.jit(bilateral(0.5, 2, ndim=2))(signal, guide)
    expected = jax.jit(cross_bilateral(0.5, 2, ndim=2, log=True))(signal, signal)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("space", SHAPES)
@pytest.mark.parametrize("power", [1, 2])
def test_laplacian_is_the_inverse_matrix(space, power, dtype):
    signal = random(*space, 2, dtype=dtype)
    found = jax.jit(laplacian(3.0, ndim=len(space), power=power))(signal, signal)
    system = np.eye(np.prod(space)) + 3.0 * dense_laplacian(space)
    inverse = np.linalg.matrix_power(np.linalg.inv(system), power)
    expected = (inverse @ np.float64(signal).reshape(-1, 2)).reshape(signal.shape)
    assert found.dtype == dtype
    np.testing.assert_allclose(found, expected, atol=20 * float(jnp.finfo(dtype).eps), rtol=0)


@pytest.mark.parametrize(("levels", "space"), [(1, (12,)), (4, (12,)), (2, (5, 4)), (1, (3, 2, 4))])
@pytest.mark.parametrize("sigma_d", [0.1, 1.0, jnp.inf])
def test_eigenvalues_are_at_most_one(levels, space, sigma_d, x64):
    filter = cross_bilateral(sigma_d, levels, ndim=len(space), sigma_s=3.0)
    dense = matrix(filter, random(*space, dtype=jnp.float64))
    assert np.abs(np.linalg.eigvals(dense)).max() <= 1 + 1e-12
    assert dense.min() >= 0
    np.testing.assert_allclose(dense.sum(1), 1, rtol=1e-14)


def test_eigenvalues_of_the_laplacian(x64):
    dense = matrix(laplacian(19.0, ndim=2, power=2), np.zeros((5, 4)))
    values = np.linalg.eigvalsh(dense)
    np.testing.assert_allclose(dense, dense.T, atol=1e-15)
    assert values.min() > 0
    assert values.max() <= 1 + 1e-14


@pytest.mark.parametrize("sigma_d", [0.0, 1e-30])
def test_no_data_scale_is_the_identity_where_the_guide_varies(sigma_d, dtype):
    signal, guide = random(6, 5, 2, dtype=dtype), random(6, 5, 1, dtype=dtype, seed=1)
    filter = jax.jit(cross_bilateral(sigma_d, 3, ndim=2))
    found = filter(signal, guide)
    np.testing.assert_array_equal(found, signal)
    half = np.where(np.arange(6)[:, None, None] < 3, 0, guide)  # filtered where it is constant
    found = np.asarray(filter(signal, half))
    np.testing.assert_array_equal(found[3:], signal[3:])
    in_space = jax.jit(cross_bilateral(jnp.inf, 3, ndim=2))(signal[:3], half[:3])
    np.testing.assert_allclose(found[:3], in_space, rtol=1e-5)


@pytest.mark.parametrize("scale", [1.0, 1e30])
def test_infinite_data_scale_is_the_spatial_filter(scale, dtype):
    signal, guide = random(6, 5, 2, dtype=dtype), scale * random(6, 5, 1, dtype=dtype, seed=1)
    expected = brute_force(np.float64(signal), np.zeros((6, 5, 1)), 1.0, 3, 1.0)
    found = jax.jit(cross_bilateral(jnp.inf, 3, ndim=2))(signal, guide)
    np.testing.assert_allclose(found, expected, atol=1e-5 if scale > 1 else 1e-6)


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("value", [0.0, 1.0, -3.7e-20, 1e30, 3e38])
def test_constants_are_preserved(name, value):
    signal = np.full((6, 5, 2), value, np.float32)
    found = compiled(name, 2)(signal, random(6, 5, 2))
    np.testing.assert_allclose(found, signal, rtol=1e-6)


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("space", [(9,), (4, 1, 6)])
def test_finite_input_is_finite_output(name, space):
    filter = compiled(name, len(space))
    signs, others = np.sign(random(*space, 2)), np.sign(random(*space, 3, seed=1))
    for signal_size, guide_size in itertools.product((0.0, 1e-40, 1.0, 3e38), repeat=2):
        found = np.asarray(filter(signal_size * signs, guide_size * others))
        assert np.all(np.isfinite(found))
        assert np.all(np.abs(found) <= 1.00001 * signal_size)


@pytest.mark.parametrize("sigma_d", [0.0, 1e-38, 1e-3, 1e30, jnp.inf])
@pytest.mark.parametrize("log", [False, True])
def test_no_scale_gives_nan(sigma_d, log):
    filter = jax.jit(cross_bilateral(sigma_d, 2, ndim=1, log=log))
    for size in (0.0, 1e-40, 1.0, 3e38):
        found = filter(random(9), size * np.sign(random(9, seed=1)))
        assert np.all(np.isfinite(found))


def test_a_scale_that_is_traced_and_wrong_gives_nan():
    filtered = jax.jit(lambda lam: laplacian(lam, ndim=1)(jnp.array([0.0, 1.0, 0.0]), jnp.zeros(3)))
    assert np.all(np.isnan(filtered(-0.2)))
    assert np.all(np.isfinite(filtered(0.2)))


@pytest.mark.parametrize("integers", [np.arange(16).reshape(4, 4), jnp.full((4, 4), 5)])
def test_whole_numbers_are_filtered_as_floats(integers):
    floats = jnp.asarray(integers, float)
    for filter in (cross_bilateral(1.0, 2, ndim=2), laplacian(1.0, ndim=2)):
        found = filter(integers, integers)
        np.testing.assert_array_equal(found, filter(floats, floats))


@pytest.mark.parametrize("coarse", [jnp.float16, jnp.bfloat16])
def test_coarse_numbers_are_filtered_in_float32(coarse):
    """Their own range is too small for sigma_d = 0 and inf, and sums of theirs lose digits."""
    signal, guide = (jnp.asarray(random(6, 5, seed=i), coarse) for i in range(2))
    fine = signal.astype(jnp.float32), guide.astype(jnp.float32)
    filters = [cross_bilateral(d, 2, ndim=2) for d in (0.0, 0.5, jnp.inf)]
    for filter in (*filters, laplacian(2.0, ndim=2)):
        found = filter(signal, guide)
        assert found.dtype == coarse
        np.testing.assert_array_equal(found, filter(*fine).astype(coarse))


def test_coarse_updates_keep_their_type_in_a_loop():
    transform = sd.filter_updates(laplacian(2.0, ndim=1))
    params = jnp.zeros(8, jnp.bfloat16)
    step = lambda u, _: (transform.update(u, optax.EmptyState(), params)[0], None)
    found, _ = jax.lax.scan(step, jnp.arange(8, dtype=jnp.bfloat16), length=3)
    assert jnp.asarray(found).dtype == jnp.bfloat16


def test_levels_set_the_reach():
    spike, flat = np.float32(np.arange(41) == 20), np.zeros(41, np.float32)
    for levels in (1, 2, 4):
        reached = np.flatnonzero(jax.jit(cross_bilateral(1.0, levels, ndim=1))(spike, flat))
        assert reached.min() == 20 - (2**levels - 1)
        assert reached.max() == 20 + (2**levels - 1)


def test_channels_are_alike_and_may_be_left_out():
    signal, guide = random(6, 5, 2, 3), random(6, 5, seed=1)
    filter = jax.jit(cross_bilateral(0.5, 2, ndim=2))
    found = np.asarray(filter(signal, guide))
    assert found.shape == signal.shape
    for i, j in np.ndindex(2, 3):
        expected = filter(signal[..., i, j], guide[..., None])
        np.testing.assert_allclose(found[..., i, j], expected, atol=1e-6)
    assert filter(signal[..., :0], guide).shape == (6, 5, 2, 0)


def test_axes_of_space_are_alike():
    signal, guide = random(4, 5, 6), random(4, 5, 6, seed=1)
    filter = jax.jit(cross_bilateral(0.5, 2, ndim=3))
    found = filter(signal.transpose(2, 0, 1), guide.transpose(2, 0, 1))
    np.testing.assert_allclose(
        found, np.asarray(filter(signal, guide)).transpose(2, 0, 1), atol=1e-6
    )


@pytest.mark.parametrize("name", FILTERS)
def test_vmap_is_a_loop(name):
    signals, guides = random(3, 6, 5), random(3, 6, 5, seed=1)
    filter = compiled(name, 2)
    found = jax.jit(jax.vmap(filter))(signals, guides)
    expected = np.stack([filter(s, g) for s, g in zip(signals, guides, strict=True)])
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize("channels", [1, 3])
def test_derivatives_of_cross_bilateral(channels, x64):
    def filter(sigma_d, sigma_s, signal, guide):
        return cross_bilateral(sigma_d, 2, ndim=1, sigma_s=sigma_s)(signal, guide)

    signal = random(5, 2, dtype=jnp.float64)
    guide = random(5, channels, dtype=jnp.float64, seed=1)
    arrays = np.float64(0.5), np.float64(1.0), signal, guide
    check_grads(jax.jit(filter), arrays, order=1, modes=["rev"])


def test_derivatives_in_float32_are_those_in_float64():
    @jax.jit
    @functools.partial(jax.grad, argnums=(0, 1, 2))
    def derivatives(sigma_d, signal, guide):
        return jnp.sum(cross_bilateral(sigma_d, 2, ndim=1)(signal, guide) ** 2)

    single = derivatives(np.float32(0.5), random(6, 2), random(6, 3, seed=1))
    with jax.enable_x64(True):
        arrays = random(6, 2, dtype=jnp.float64), random(6, 3, dtype=jnp.float64, seed=1)
        double = derivatives(np.float64(0.5), *arrays)
    for found, expected in zip(single, double, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("channels", [1, 3])
def test_derivatives_are_finite(channels):
    @jax.jit
    @functools.partial(jax.grad, argnums=(0, 1, 2))
    def derivatives(sigma_d, signal, guide):
        return jnp.sum(cross_bilateral(sigma_d, 2, ndim=1)(signal, guide) ** 2)

    for size in (0.0, 1.0, 1e30):
        guide = size * random(6, channels, seed=1)
        for derivative in derivatives(np.float32(0.5), random(6, 2), guide):
            assert np.all(np.isfinite(derivative))


def test_derivatives_of_the_laplacian(x64):
    def filter(lam, signal):
        return laplacian(lam, ndim=1)(signal, signal)

    arrays = jnp.array(2.0), random(4, 3, dtype=jnp.float64)
    check_grads(jax.jit(filter), arrays, order=1, modes=["rev"])


def test_a_signal_may_be_narrower_than_its_guide(x64):
    signal, guide = random(6, 5), random(6, 5, dtype=jnp.float64, seed=1)
    filter = jax.jit(cross_bilateral(0.5, 2, ndim=2))
    found = filter(signal, guide)
    assert found.dtype == jnp.float32
    expected = filter(signal, guide.astype(np.float32))
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_bad_arguments_are_refused():
    for make in (cross_bilateral, bilateral):
        with pytest.raises(ValueError, match="at least 1"):
            make(0.1, 0, ndim=2)
        with pytest.raises(TypeError, match="levels must be a whole number"):
            make(0.1, 3.0, ndim=2)  # pyright: ignore[reportArgumentType]
        with pytest.raises(ValueError, match="must not be negative"):
            make(-0.1, 1, ndim=2)
        with pytest.raises(ValueError, match="must be positive, in pixels"):
            make(0.1, 1, ndim=2, sigma_s=0.0)
        with pytest.raises(ValueError, match="channels not counted"):
            make(0.1, 1, ndim=4)
    with pytest.raises(ValueError, match="finite and not negative"):
        laplacian(-1.0, ndim=1)
    with pytest.raises(ValueError, match="finite and not negative"):
        laplacian(jnp.inf, ndim=1)
    with pytest.raises(ValueError, match="power"):
        laplacian(1.0, ndim=1, power=0)
    with pytest.raises(ValueError, match="channels not counted"):
        laplacian(1.0, ndim=0)


def test_arrays_that_do_not_match_are_refused():
    filter = cross_bilateral(0.1, 1, ndim=2)
    with pytest.raises(ValueError, match="same 2 leading axes"):
        filter(jnp.zeros((4, 4)), jnp.zeros((4, 5)))
    with pytest.raises(ValueError, match="fewer than ndim=2"):
        filter(jnp.zeros(4), jnp.zeros(4))


@pytest.mark.parametrize("scales", [(-1.0, 1.0), (jnp.nan, 1.0), (1.0, 0.0), (1.0, -1.0)])
def test_traced_scales_that_are_invalid_give_nan(scales):
    def filter(sigma_d, sigma_s):
        return cross_bilateral(sigma_d, 1, ndim=1, sigma_s=sigma_s)(jnp.ones(3), jnp.ones(3))

    assert np.all(np.isnan(jax.jit(filter)(*map(np.float32, scales))))


def test_memory_grows_with_the_signal_only():
    signal = jnp.zeros((64, 64, 64))
    compiled = jax.jit(cross_bilateral(0.1, 2, ndim=3)).lower(signal, signal).compile()
    analysis = compiled.memory_analysis()
    assert analysis is not None
    # padded signal and guide, not 27 taps of them
    assert analysis.temp_size_in_bytes < 8 * signal.nbytes


def test_what_is_switched_off_is_not_computed():
    signal = jnp.zeros((6, 5))
    plain = str(jax.make_jaxpr(cross_bilateral(0.1, 1, ndim=2))(signal, signal))
    assert " log " not in plain
    assert "sqrt" not in plain  # one channel has no norm
    column = str(jax.make_jaxpr(cross_bilateral(0.1, 1, ndim=2))(signal[:1], signal[:1]))
    assert column.count("custom_jvp_call") == 2  # an axis of one pixel has no taps


@pytest.mark.parametrize("shape", [(0, 4), (4, 0), (4, 4, 0)])
def test_laplacian_of_nothing_is_nothing(shape):
    assert laplacian(3.0, ndim=2)(jnp.zeros(shape), jnp.zeros(shape)).shape == shape
