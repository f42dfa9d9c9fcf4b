"""Every sampler: its distribution, structure, addressing, and count of evaluations."""

import math
from collections import Counter
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from closed_forms import assert_unbiased, boxes, half_space, keys
from parts import new_ones
from scipy import integrate, stats

import smoothdiff as sd
from smoothdiff import _directions
from smoothdiff._noise import as_sampler
from tests.parts import quick_of

KEY = jax.random.key(0)
GUMBEL = optax.perturbations.Gumbel()

# sampler and a number of points that it can draw in three dimensions
NORMAL = {
    "gaussian": (sd.Gaussian(), 8),
    "pairs": (sd.Gaussian(antithetic=True), 8),
    "sobol": (sd.Sobol(), 8),
    "sobol, no power of two": (sd.Sobol(), 7),
    "sobol pairs": (sd.Sobol(antithetic=True), 8),
    "sobol replicates": (sd.Sobol(replicates=2), 8),
    "frames": (sd.Orthogonal(antithetic=False), 6),
    "frames of pairs": (sd.Orthogonal(), 12),
    "part of a frame": (sd.Orthogonal(antithetic=False), 2),
    "part of a frame of pairs": (sd.Orthogonal(), 4),
}
WEIGHTED = {
    "aggregate 1": (sd.Aggregate(1), 8),
    "aggregate 2": (sd.Aggregate(2), 8),
    "aggregate, single": (sd.Aggregate(2, antithetic=False, share=0.5), 7),
    "aggregate, quasi": (sd.Aggregate(2, antithetic=False, quasi=True), 8),
    "uniform": (sd.Uniform(), 7),
    "uniform, quasi pairs": (sd.Uniform(antithetic=True, quasi=True), 8),
}
KNOWN = {**NORMAL, **WEIGHTED, "noise": (as_sampler(None, GUMBEL), 7)}
NEW = new_ones(sd.AbstractSampler, [type(sampler) for sampler, _ in KNOWN.values()])
ALL = KNOWN | {name: (sampler, 12) for name, sampler in NEW.items()}
# every sampler, alone and in pairs, independent and scrambled
ADDRESSED = ("gaussian", "pairs", "sobol pairs", "sobol replicates", "frames", "frames of pairs")
ADDRESSED += ("aggregate 1", "aggregate, quasi", "uniform", "uniform, quasi pairs", "noise", *NEW)


def draw(sampler, num_samples, n, many=None, dtype=jnp.float32):
    """A set of points, or one for each of many keys."""
    one = lambda key: sampler.draw(key, 0, num_samples, num_samples, n, dtype)
    return jax.jit(one)(KEY) if many is None else jax.jit(jax.vmap(one))(many)


# ---------------------------------------------------------------------------------------------
# distribution


@pytest.mark.parametrize("name", NORMAL)
def test_every_point_is_standard_normal(name):
    """Point by point over many keys, so that dependence within a set does not matter."""
    sampler, num = NORMAL[name]
    z, log_ratio = draw(sampler, num, 3, keys(4000))
    assert log_ratio is None
    z = np.asarray(z, float)
    pvalues = [[stats.kstest(z[:, i, j], "norm").pvalue for j in range(3)] for i in range(num)]
    assert np.min(pvalues) > 0.01 / (3 * num), pvalues
    second = np.einsum("kij,kil->ijl", z, z) / len(z)
    np.testing.assert_allclose(second, np.broadcast_to(np.eye(3), second.shape), atol=4.5 * 0.0224)
    # one key knows nothing of the next
    assert np.max(np.abs(np.mean(z[:-1] * z[1:], axis=0))) < 4.5 / np.sqrt(len(z))
    if "pairs" in name:
        np.testing.assert_array_equal(z[:, 0::2], -z[:, 1::2])


@pytest.mark.parametrize("name", [name for name in WEIGHTED if "aggregate" in name])
def test_weighted_points_have_the_moments_of_normal_ones(name):
    sampler, num = WEIGHTED[name]
    z, log_ratio = draw(sampler, num, 2, keys(4000))
    z, w = np.asarray(z), np.exp(log_ratio)
    moments = [w, w * z[..., 0], w * z[..., 1] ** 2, w * z[..., 0] * z[..., 1], w * z[..., 0] ** 4]
    found = np.mean(np.stack(moments, axis=-1), axis=1)
    assert_unbiased(found, np.array([1.0, 0.0, 1.0, 0.0, 3.0]), resolution=0.03)


@pytest.mark.parametrize("name", ADDRESSED)
def test_rows_are_addressed_one_by_one(name):
    """Any part of a set can be drawn alone, also where its start is traced."""
    sampler, num = ALL[name]
    n, many = 3, 12 * num
    sampler.check(many, n)
    count = 2 * sampler.block(many, n)
    starts = np.array([0, count, count // 2, many - count])

    @jax.jit
    def run():
        part = lambda start, count: sampler.draw(KEY, start, count, many, n, jnp.float32)
        return part(0, many), jax.lax.map(lambda start: part(start, count), starts)

    whole, parts = run()
    assert jax.tree.structure(whole) == jax.tree.structure(parts)
    for a, b in zip(jax.tree.leaves(parts), jax.tree.leaves(whole), strict=True):
        want = np.stack([np.asarray(b)[start : start + count] for start in starts])
        np.testing.assert_allclose(a, want, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", ALL)
def test_precision_is_that_asked_for(name, x64):
    """float32 parameters stay so where float64 is switched on."""
    sampler, num = ALL[name]
    for dtype in (jnp.float32, jnp.float64):
        z, log_ratio = jax.eval_shape(
            lambda d=dtype: sampler.draw(KEY, 0, num, num, 3, d)  # every sampler's own arithmetic
        )
        assert z.dtype == dtype
        assert log_ratio is None or log_ratio.dtype == dtype


# ---------------------------------------------------------------------------------------------
# Sobol


def fractions(sampler, num_samples, n):
    """The uniform numbers in [0, 1) that the points come from."""
    z, _ = draw(sampler, num_samples, n, dtype=jnp.float64)
    return stats.norm.cdf(np.asarray(z))


@pytest.mark.parametrize(("n", "bits"), [(1, 8), (2, 1), (7, 5), (300, 20), (21_201, 4)])
def test_direction_numbers_are_those_of_scipy(n, bits):
    numbers = _directions.direction_numbers(n, bits)
    sequence = stats.qmc.Sobol(n, scramble=False, bits=32)
    for k, row in enumerate(numbers):
        assert row.dtype == np.uint32
        point = sequence.reset().fast_forward(2 ** (k + 1) - 1).random(1)[0]
        np.testing.assert_array_equal(row / 2.0**32, point)


@pytest.mark.parametrize("file", ["none", "other"])
def test_without_the_file_of_scipy_its_sequence_is_asked(file, monkeypatch, tmp_path):
    numbers, path = _directions.direction_numbers(7, 5), tmp_path / "numbers.npz"
    if file == "other":
        np.savez(path, poly=np.ones(9, np.int64))
    monkeypatch.setattr(_directions, "_file", lambda: path)
    np.testing.assert_array_equal(_directions.direction_numbers.__wrapped__(7, 5), numbers)


def test_direction_number_k_is_odd_in_units_of_its_last_digit():
    """Of all 32: for the last ones scipy would have to make 2^32 points."""
    numbers = _directions.direction_numbers(300, 32)
    assert numbers.shape == (32, 300)
    for k, row in enumerate(numbers):
        assert np.all(row >> np.uint32(31 - k) & 1 == 1)
        assert np.all(row & np.uint32(2 ** (31 - k) - 1) == 0)


@pytest.mark.parametrize("k", [1, 3, 6])
def test_sobol_puts_one_point_in_each_cell(k, x64):
    """N = 2^k: each interval of length 1/N in each dimension holds one point."""
    cells = np.floor(fractions(sd.Sobol(), 2**k, 12) * 2**k).astype(int)
    for column in cells.T:
        assert sorted(column) == list(range(2**k))


def test_sobol_puts_one_point_in_each_elementary_rectangle(x64):
    """The first two dimensions are a (0, m, 2)-net in base 2, which scrambling keeps."""
    u = fractions(sd.Sobol(), 64, 2)
    for a in range(7):
        cells = np.floor(u * [2**a, 2 ** (6 - a)]).astype(int)
        assert len({tuple(cell) for cell in cells}) == 64


@pytest.mark.parametrize("num_samples", [1, 100])
def test_sobol_takes_any_number_of_points(num_samples, x64):
    u = fractions(sd.Sobol(), num_samples, 5)
    for coarse, low, high in ((64, 1, 2), (128, 0, 1)):
        if num_samples == 1:
            low = 0
        for column in np.floor(u * coarse).astype(int).T:
            counts = np.bincount(column, minlength=coarse)
            assert low <= counts.min() <= counts.max() <= high


def test_sobol_replicates_are_independent_sets(x64):
    u = fractions(sd.Sobol(replicates=4), 64, 3)
    for part in u.reshape(4, 16, 3):
        for column in np.floor(part * 16).astype(int).T:
            assert sorted(column) == list(range(16))
    assert len(np.unique(u[:, 0])) == 64
    z, _ = draw(sd.Sobol(replicates=2), 8, 2, keys(4000), jnp.float64)
    first, second = np.asarray(z).reshape(4000, 2, 8).swapaxes(0, 1)
    correlation = first.T @ second / 4000
    assert np.max(np.abs(correlation)) < 4.5 / np.sqrt(4000)


def test_scrambling_is_nested_and_uniform(x64):
    """Owen's: two points share the digits they shared, differ in the next, and then know nothing.

    Points 0 and 1 of a Sobol sequence differ in their first digit.
    """
    z, _ = draw(sd.Sobol(), 8, 2, keys(4000), jnp.float64)
    digits = np.floor(stats.norm.cdf(np.asarray(z)) * 2.0**12).astype(int)
    same = digits[:, 0] ^ digits[:, 1]
    assert np.all(same >> 11 == 1)
    share = [np.mean((same >> bit) & 1, axis=0) for bit in range(11)]
    assert np.max(np.abs(np.array(share) - 0.5)) < 4.5 * 0.5 / np.sqrt(4000)


def test_sobol_beyond_the_tabulated_dimensions():
    """The documented fallback: 21,201 dimensions from the sequence, the others independent."""
    n = 21_300
    z = np.asarray(draw(sd.Sobol(), 4, n)[0], float)
    for row in z:
        assert stats.kstest(row, "norm").pvalue > 1e-3
        assert stats.kstest(row[21_201:], "norm").pvalue > 1e-3
    quarter = np.floor(stats.norm.cdf(z) * 4).astype(int)
    even = np.all(np.sort(quarter, axis=0) == np.arange(4)[:, None], axis=0)
    assert np.all(even[:21_201])
    assert np.mean(even[21_201:]) < 0.4  # 4! / 4^4 of independent columns are so by chance
    # random numbers of their own, not those that scramble the first ones
    assert np.max(np.abs(np.corrcoef(z[:, :99], z[:, -99:]) - np.eye(8))) < 1
    g = sd.smooth_grad(lambda x: jnp.sum(x[-3:]), 1.0, sampler=sd.Sobol(), num_samples=4)
    assert jnp.all(jnp.isfinite(jax.jit(g)(KEY, jnp.zeros(n))))


# ---------------------------------------------------------------------------------------------
# frames


@pytest.mark.parametrize(
    ("n", "parts", "antithetic"), [(1, 3, True), (5, 3, False), (5, 3, True), (5, 0.4, True)]
)
def test_frames_are_perpendicular(n, parts, antithetic):
    pairs = 2 if antithetic else 1
    num = round(n * parts) * pairs
    z, _ = draw(sd.Orthogonal(antithetic=antithetic), num, n)
    z = np.asarray(z)[::pairs]
    size = min(n, len(z))
    for frame in z.reshape(-1, size, n):
        unit = frame / np.linalg.norm(frame, axis=1, keepdims=True)
        np.testing.assert_allclose(unit @ unit.T, np.eye(size), atol=1e-5)
    # another frame looks elsewhere
    if len(z) > size > 1:
        assert np.max(np.abs(z[:size] @ z[size : 2 * size].T)) > 0.1


def test_radii_are_chi_distributed_and_directions_uniform():
    z, _ = draw(sd.Orthogonal(antithetic=False), 6, 3, keys(4000))
    radius = np.linalg.norm(np.asarray(z, float), axis=2)
    for column in radius.T:
        assert stats.kstest(column, stats.chi(3).cdf).pvalue > 1e-3
    correlation = np.corrcoef(radius.T) - np.eye(6)
    assert np.max(np.abs(correlation)) < 4.5 / np.sqrt(4000)
    # in three dimensions each coordinate of a uniform direction is uniform
    for i in range(6):
        for j in range(3):
            cosine = np.asarray(z[:, i, j], float) / radius[:, i]
            assert stats.kstest(cosine, stats.uniform(-1, 2).cdf).pvalue > 1e-3 / 18


# ---------------------------------------------------------------------------------------------
# densities of the proposals


def mixture(order, share, n):
    """The proposal's density as the paper words it: choose an element, then its dimensions."""

    def density(z):
        p = stats.norm.pdf(z)
        kernel = [
            p,
            np.abs(z) * p / (2 * stats.norm.pdf(0)),
            np.abs(z**2 - 1) * p / (4 * stats.norm.pdf(1)),
        ]
        total = 0.0
        elements = [(i,) for i in range(n)] if order == 1 else list(np.ndindex(n, n))
        for element in elements:
            times = Counter(element)
            orders = [times[d] for d in range(n)]
            total = total + math.prod(kernel[o][d] for d, o in enumerate(orders))
        return share * np.prod(p, axis=0) + (1 - share) * total / len(elements)

    return density


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
def test_aggregate_ratio_is_that_of_the_mixture(order, n, share, x64):
    z = 2 * np.asarray(jax.random.normal(KEY, (200, n), jnp.float64))
    log_ratio = jax.jit(sd.Aggregate(order, share=share).log_ratio)(z)
    points = z.T
    want = np.prod(stats.norm.pdf(points), axis=0) / mixture(order, share, n)(points)
    np.testing.assert_allclose(np.exp(log_ratio), want, rtol=1e-9)
    if share:
        assert np.max(np.exp(log_ratio)) <= 1 / share * (1 + 1e-12)


@pytest.mark.parametrize("order", [1, 2])
def test_aggregate_density_is_normalised(order):
    """By quadrature of the density over the normal one, in one and two dimensions."""
    nodes, weights = np.polynomial.legendre.leggauss(200)
    x = np.concatenate([(nodes + 1) / 2 * (b - a) + a for a, b in ((-8, -1), (-1, 0))])
    w = np.concatenate([weights / 2 * (b - a) for a, b in ((-8, -1), (-1, 0))])
    log_ratio = jax.jit(sd.Aggregate(order).log_ratio)
    ratio = lambda z: np.exp(-np.asarray(log_ratio(np.float32(z)), float))
    np.testing.assert_allclose(2 * np.sum(w * stats.norm.pdf(x) * ratio(x[:, None])), 1, rtol=1e-5)
    grid = np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1).reshape(-1, 2)
    volume = np.outer(w * stats.norm.pdf(x), w * stats.norm.pdf(x)).reshape(-1)
    np.testing.assert_allclose(4 * np.sum(volume * ratio(grid)), 1, rtol=1e-5)


@pytest.mark.parametrize(("order", "quasi"), [(1, True), (2, False)])
def test_aggregate_points_follow_the_mixture(order, quasi):
    grid = np.linspace(-8, 8, 16_001)
    mass = integrate.cumulative_trapezoid(mixture(order, 0.1, 1)(grid[None]), grid, initial=0)
    sampler = sd.Aggregate(order, antithetic=False, quasi=quasi)
    z, _ = draw(sampler, 4, 1, keys(5000))
    for row in range(4):
        found = np.asarray(z[:, row, 0], float)
        assert stats.kstest(found, lambda x: np.interp(x, grid, mass)).pvalue > 1e-3
    # in two dimensions: the shares of the quadrants beyond one and within
    side = np.linspace(-8, 8, 1601)
    plane = np.stack(np.meshgrid(side, side, indexing="ij"))
    density = mixture(order, 0.1, 2)(plane)
    inside = (np.abs(plane[0]) < 1) & (np.abs(plane[1]) < 1)
    want = np.sum(density * inside) * (side[1] - side[0]) ** 2
    z, _ = draw(sampler, 4, 2, keys(5000))
    share = np.mean(np.all(np.abs(z) < 1, axis=2), axis=1)
    assert abs(share.mean() - want) < 4.5 * share.std() / np.sqrt(5000) + 2e-3


def test_the_share_keeps_weights_bounded():
    """Where the derivative vanishes: weights without bound as published, not so when mixed."""
    orders: tuple[tuple[Literal[1, 2], float], ...] = ((1, 0.0), (2, 1.0))
    for order, at in orders:
        z = jnp.array([[at + 1e-3]])
        for share in (0.1, 0.0):
            w = np.exp(jax.jit(sd.Aggregate(order, share=share).log_ratio)(z))
            assert (w[0] > 100) == (share == 0)


@pytest.mark.parametrize(("order", "share"), [(1, 0.1), (2, 0.0)])
def test_log_weights_in_ten_thousand_dimensions(order, share):
    n = 10_000
    sampler = sd.Aggregate(order, share=share)
    _z, log_ratio = draw(sampler, 16, n)
    assert log_ratio is not None
    assert jnp.all(jnp.isfinite(log_ratio))
    # the mean over ten thousand elements hardly varies
    np.testing.assert_allclose(log_ratio, 0, atol=0.1)
    options: dict[str, Any] = {"sampler": sampler, "num_samples": 16, "baseline": "mean"}
    fun = lambda x: jnp.sum(x > 0).astype(x.dtype)
    grad = sd.smooth_grad(fun, 1.0, **options)
    hvp = sd.smooth_hvp(fun, 1.0, **options)
    x = jnp.zeros(n)
    assert jnp.all(jnp.isfinite(jax.jit(grad)(KEY, x)))
    assert jnp.all(jnp.isfinite(jax.jit(hvp)(KEY, x, x + 1)))


@pytest.mark.parametrize(("half_width", "quasi"), [(1.0, False), (3.0, True)])
def test_uniform_is_biased_by_what_it_cuts_off(half_width, quasi):
    """Its expectation is the integral of f times the Gaussian over the box, as documented."""
    sampler = sd.Uniform(half_width, quasi=quasi)
    g = sd.smooth_value_and_grad(
        boxes, 0.5, sampler=sampler, baseline="none", num_samples=64, argnums=0
    )
    x = jnp.array([0.1, 0.2])
    found = jax.jit(jax.vmap(g, in_axes=(0, None)))(keys(4096), x)
    line = (np.arange(1000) + 0.5) / 1000 * 2 * half_width - half_width
    z = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
    w = np.prod(stats.norm.pdf(z), axis=1) * (2 * half_width / 1000) ** 2
    f = np.asarray(jax.jit(jax.vmap(boxes))(x[None] + 0.5 * jnp.asarray(z, jnp.float32)), float)
    value, grad = np.sum(w * f), (w * f) @ z / 0.5
    assert_unbiased(found, (np.float64(value), grad), resolution=0.03)
    lost = 1 - np.sum(w)
    assert abs(lost - (1 - (2 * stats.norm.cdf(half_width) - 1) ** 2)) < 1e-3


# ---------------------------------------------------------------------------------------------
# evaluations


def counted(count):
    """Half-space as a host function that counts the points that it is given."""

    def host(x):
        rows = np.asarray(x).reshape(-1, x.shape[-1])
        count.append(len(rows))
        return (np.sum(np.asarray(x), axis=-1) > 0).astype(np.float32)

    out = jax.ShapeDtypeStruct((), jnp.float32)
    return lambda x: jax.pure_callback(host, out, x, vmap_method="expand_dims")


@pytest.mark.parametrize("n", quick_of([1, 4], [4]))
def test_evaluations_are_those_of_table_1(n):
    """Plain and aggregate sampling: N for all elements. By element: n N and n (n + 1) / 2 N.

    The paper counts n^2 for the Hessian by element; its symmetry is used here.
    """
    num, x = 8, jnp.zeros(n)
    by_element = {1: n * num, 2: n * (n + 1) // 2 * num}
    cases = [
        (sd.smooth_grad, {"sampler": sd.Aggregate(1)}, num),
        (sd.Importance(1), {}, by_element[1]),
        (sd.smooth_hessian, {"sampler": sd.Gaussian()}, num),
        (sd.smooth_hessian, {"sampler": sd.Aggregate(2)}, num),
        (sd.Importance(2), {}, by_element[2]),
        (sd.smooth_hvp, {"sampler": sd.Aggregate(2)}, num),
    ]
    counts: list[list[int]] = [[] for _ in cases]

    def estimate(case, count):
        transform, options, _ = case
        g = transform(counted(count), 0.5, **options, num_samples=num, baseline="mean")
        return g(KEY, x, x) if transform is sd.smooth_hvp else g(KEY, x)

    run = jax.jit(lambda: list(map(estimate, cases, counts)))

    jax.block_until_ready(run())
    assert [sum(count) for count in counts] == [want for *_, want in cases]


@pytest.mark.parametrize("blur", ["all", "own"])
def test_importance_is_unbiased_by_default(blur):
    """The sine, whose own derivative is smoothed by one normal number, and the sum of all."""
    sine = lambda x: jnp.sum(jnp.sin(x)) + jnp.cos(jnp.sum(x))
    x, smoothed = jnp.full(3, 0.3), np.exp(-0.5)
    # the sum of all has a variance of 3 where all are smoothed, and of 1 where one is
    inner = np.exp(-3 / 2 if blur == "all" else -0.5)
    expected = smoothed * np.cos(0.3) - inner * np.sin(0.9)
    estimate = sd.Importance(1, blur=blur)(sine, 1.0, num_samples=16)
    assert_unbiased(
        jax.vmap(lambda k: estimate(k, x))(keys(2000)), jnp.full(3, expected), resolution=0.02
    )


@pytest.mark.parametrize("order", [1, 2])
def test_importance_can_be_differentiated(order):
    """With respect to the parameters and sigma, against AD of the closed form."""
    wave = lambda x: jnp.sin(x[0] + 2 * x[1])
    smoothed = lambda x, s: jnp.exp(-(s[0] ** 2 + 4 * s[1] ** 2) / 2) * wave(x)
    exact = jax.grad(smoothed) if order == 1 else jax.hessian(smoothed)
    x, s = jnp.array([0.3, 0.4]), jnp.array([0.8, 0.5])
    estimate = lambda x, s, k: sd.Importance(order)(wave, s, num_samples=64)(k, x)
    found = jax.jit(jax.vmap(jax.jacfwd(estimate, (0, 1)), (None, None, 0)))(x, s, keys(1000))
    for estimates, want in zip(found, jax.jacfwd(exact, (0, 1))(x, s), strict=True):
        assert_unbiased(estimates, want, resolution=0.05)


def test_importance_over_own_parameters_says_that_it_has_no_derivative(key):
    estimate = lambda x, s: sd.Importance(1, blur="own")(jnp.sum, s, num_samples=4)(key, x)
    for argnums in (0, 1):
        with pytest.raises(TypeError, match='to differentiate it again use blur="all"'):
            jax.jacfwd(estimate, argnums)(jnp.ones(2), 0.5)
    # what the function depends on besides can be differentiated
    scaled = lambda a: sd.Importance(1, blur="own")(
        lambda x, a: a * jnp.sum(x), 0.5, num_samples=4, baseline="none"
    )(key, jnp.ones(2), a)
    np.testing.assert_allclose(jax.jacfwd(scaled)(2.0), scaled(1.0), rtol=1e-5)


def test_points_of_one_parameter_have_no_fit():
    for baseline in ("gp", "linear", "quadratic"):
        with pytest.raises(ValueError, match='blur="own" goes with baseline="mean"'):
            sd.Importance(1, blur="own")(jnp.sum, 1.0, baseline=baseline)


# ---------------------------------------------------------------------------------------------
# noise


@pytest.mark.parametrize(
    ("noise", "baseline"), [(GUMBEL, "none"), (optax.perturbations.Normal(), "mean")]
)
def test_noise_smooths_as_in_optax(noise, baseline):
    """The same value and Jacobian in expectation as `make_perturbed_fun`."""
    one_hot = lambda x: jax.nn.one_hot(jnp.argmax(x), 3, dtype=x.dtype)
    x, sigma = jnp.array([0.3, -0.2, 0.5]), 0.8
    ours = sd.smooth(one_hot, sigma, noise=noise, num_samples=64, baseline=baseline)
    theirs = optax.perturbations.make_perturbed_fun(one_hot, 64, sigma, noise)
    both = []
    for g in (ours, theirs):
        run = lambda key, g=g: (g(key, x), jax.jacrev(lambda x: g(key, x))(x))
        # optax's own arithmetic needs the promotion that the tests forbid
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            both.append(jax.tree.map(np.asarray, jax.jit(jax.vmap(run))(keys(2000))))
    for a, b in zip(*both, strict=True):
        error = np.sqrt(np.var(a, axis=0) / 2000 + np.var(b, axis=0) / 2000)
        assert np.max(np.abs(a.mean(axis=0) - b.mean(axis=0)) / error) < 4.5
        assert np.max(error) < 0.02
    if noise is GUMBEL:
        soft = lambda x: jax.nn.softmax(x / sigma)
        exact = jax.jit(lambda x: (soft(x), jax.jacobian(soft)(x)))(x)
        assert_unbiased(both[0], exact, resolution=0.03)


def test_noise_has_second_derivatives_and_those_in_sigma():
    x = jnp.array([0.3, -0.2])
    fun = lambda x: (x[0] > x[1]).astype(x.dtype)

    def estimate(key):
        F = lambda x, sigma: sd.smooth(fun, sigma, noise=GUMBEL, num_samples=64)(key, x)
        return jax.hessian(F)(x, 0.8), jax.grad(F, argnums=1)(x, 0.8)

    @jax.jit
    def want(x, sigma):
        exact = lambda x, sigma: jax.nn.sigmoid((x[0] - x[1]) / sigma)
        return jax.hessian(exact)(x, sigma), jax.grad(exact, argnums=1)(x, sigma)

    assert_unbiased(jax.jit(jax.vmap(estimate))(keys(4000)), want(x, 0.8), resolution=0.1)


@pytest.mark.parametrize("baseline", ["linear", "quadratic", "gp"])
def test_fits_do_not_know_other_noise(baseline):
    g = sd.smooth_grad(half_space, 0.5, noise=GUMBEL, baseline=baseline, num_samples=64)
    with pytest.raises(ValueError, match='baseline="mean"'):
        g(KEY, jnp.zeros(2))


def test_noise_takes_no_support():
    """A support needs the weight of each parameter by itself."""
    g = sd.smooth_grad(lambda x: x, 0.5, noise=GUMBEL, support=sd.local_support(0), num_samples=4)
    with pytest.raises(ValueError, match="no noise"):
        g(KEY, jnp.zeros(2))


# ---------------------------------------------------------------------------------------------
# bad input


BAD = {
    "odd pairs of Sobol points": (sd.Sobol(antithetic=True), 7, "multiple of 2"),
    "uneven replicates": (sd.Sobol(replicates=3), 64, "multiple of 3"),
    "uneven replicates of pairs": (sd.Sobol(antithetic=True, replicates=2), 6, "multiple of 4"),
    "odd pairs of frames": (sd.Orthogonal(), 5, "even"),
    "part of a second frame": (sd.Orthogonal(antithetic=False), 3, "multiple of 2"),
    "odd aggregate pairs": (sd.Aggregate(1), 7, "multiple of 2"),
}


@pytest.mark.parametrize(("sampler", "num", "message"), BAD.values(), ids=BAD)
def test_numbers_of_samples_that_cannot_be(sampler, num, message):
    with pytest.raises(ValueError, match=message):
        sd.smooth_grad(half_space, 0.5, sampler=sampler, num_samples=num)(KEY, jnp.zeros(2))


def test_samplers_that_cannot_be():
    with pytest.raises(ValueError, match="replicates"):
        sd.Sobol(replicates=0)
    with pytest.raises(ValueError, match="share"):
        sd.Aggregate(1, share=1.5)
    with pytest.raises((ValueError, TypeError)):
        sd.Aggregate(3)  # pyright: ignore[reportArgumentType]
    with pytest.raises((ValueError, TypeError)):
        sd.Importance(3)  # pyright: ignore[reportArgumentType]
    for width in (0.0, -1.0):
        with pytest.raises(ValueError, match="half_width"):
            sd.Uniform(half_width=width)
    with pytest.raises(TypeError, match="replicates must be a whole number"):
        sd.Sobol(replicates=2.0)  # pyright: ignore[reportArgumentType]


class Wide(sd.AbstractSampler):
    """Points that are twice as wide as normal ones, and that forget to say so."""

    weighted: bool = False

    def block(self, num_samples, n):
        return 1

    def draw(self, key, start, count, num_samples, n, dtype):
        z, _ = sd.Gaussian().draw(key, start, count, num_samples, n, dtype)
        return 2 * z, jnp.zeros(count, dtype) if self.weighted else None


class SaysNormal(Wide):
    gaussian: ClassVar[bool] = True


class SaysWeighted(Wide):
    gaussian: ClassVar[bool] = False


def test_a_sampler_must_say_whether_its_points_are_normal():
    with pytest.raises(TypeError, match=r"Wide does not say.*gaussian: ClassVar\[bool\] = True"):
        Wide()


@pytest.mark.parametrize(
    ("sampler", "message"),
    [
        (SaysNormal(weighted=True), r"draw` returns weights: write.*gaussian.*= False"),
        (SaysWeighted(), "draw` returns no weights: return the logarithms"),
    ],
)
def test_what_a_sampler_says_and_draws_must_agree(sampler, message):
    g = sd.smooth_grad(half_space, 0.5, sampler=sampler, num_samples=4)
    with pytest.raises(TypeError, match=message):
        g(KEY, jnp.zeros(2))
