"""What Newton-CG is made of: the inner solver, the metric with its bounds."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from smoothdiff._solvers._metric import MOST_DIRECTIONS, Metric
from smoothdiff._solvers._noisy_step import outcome
from smoothdiff._solvers._scalar_fit import fit
from smoothdiff._solvers._trust_region import truncated_cg

# the inner solver


@jax.jit
def within(hessian, grad, radius):
    return truncated_cg(lambda v: hessian @ v, grad, radius)


def symmetric(seed, eigenvalues):
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(len(eigenvalues),) * 2))[0]
    return turn * eigenvalues @ turn.T, rng.normal(size=len(eigenvalues))


@pytest.mark.parametrize("seed", range(3))
def test_inside_the_region_the_step_is_newtons(seed, dtype):
    hessian, grad = symmetric(seed, [1.0, 3.0, 10.0, 40.0])
    exact = -np.linalg.solve(hessian, grad)
    radius = 2 * np.linalg.norm(exact)
    step = within(*(jnp.asarray(a, dtype) for a in (hessian, grad, radius)))
    size = float(jnp.finfo(dtype).eps) ** 0.5 * np.linalg.norm(grad)
    np.testing.assert_allclose(step, exact, atol=2 * size)


@pytest.mark.parametrize("eigenvalues", [(1, 3, 10, 40), (-1, 2, 5, 9), (-4, -3, -2, -1), (0,) * 4])
@pytest.mark.parametrize("radius", [1e-3, 0.03, 1.0, 100.0])
def test_the_step_is_no_worse_than_cauchys_and_reaches_the_boundary(eigenvalues, radius, x64):
    for seed in range(5):
        hessian, grad = symmetric(seed, np.array(eigenvalues, float))
        step = np.asarray(within(*(jnp.asarray(a) for a in (hessian, grad, radius))))
        model = lambda p, h=hessian, g=grad: g @ p + p @ h @ p / 2
        bent, size = grad @ hessian @ grad, np.linalg.norm(grad)
        share = min(1, size**3 / (radius * bent)) if bent > 0 else 1
        assert model(step) <= model(-share * radius / size * grad) * (1 - 1e-12)
        length = np.linalg.norm(step)
        assert length <= radius * (1 + 1e-9)
        newton = np.linalg.norm(np.linalg.pinv(hessian) @ grad)
        if min(eigenvalues) <= 0 or newton > radius:
            assert length == pytest.approx(radius)


def test_without_a_gradient_there_is_no_step(dtype):
    hessian, _ = symmetric(0, [-1.0, 2.0, 5.0, 9.0])
    step = within(jnp.asarray(hessian, dtype), jnp.zeros(4, dtype), jnp.ones((), dtype))
    np.testing.assert_array_equal(step, 0)


# what is made of a step


def test_a_step_is_good_if_it_led_down_or_may_have():
    """From the point before to the origin, on a bowl and on nothing but noise."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(40, 2)).astype(np.float32)
    bowl = np.sum((points - 3) ** 2, axis=1)
    noise = rng.normal(size=40).astype(np.float32)

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(None, 0, 0, 0))
    def judged(points, values, before, promised):
        return outcome(fit(points, values, jnp.ones(40, bool)), before, promised)

    # from here to the origin the bowl falls by as much
    up, down = np.array([0.5, 0.5], np.float32), np.array([-0.5, -0.5], np.float32)
    fall = np.float32(2 * (3.5**2 - 3**2))
    steps = {
        "as promised": (bowl, down, fall, 1),
        "less than promised": (bowl, down, 10 * fall, 0.1),
        "next to nothing of it": (bowl, down, 1000 * fall, 0),
        "up": (bowl, up, fall, -(3**2 - 2.5**2) / (3.5**2 - 3**2)),
        "up in noise": (noise, up, np.float32(1e-3), None),
        "no step": (noise, 0 * up, np.float32(0), 1),
    }
    columns = [np.stack(column) for column in list(zip(*steps.values(), strict=True))[:3]]
    for name, good, ratio in zip(steps, *judged(points, *columns), strict=True):
        expected = steps[name][3]
        assert good == (name not in ("next to nothing of it", "up")), name
        assert expected is None or ratio == pytest.approx(expected, abs=0.03), name


# the metric

METRIC = jax.jit(Metric.of, static_argnums=1)
AND_BACK = jax.jit(lambda metric, x: (metric.into(metric.out(x)), metric.out(metric.into(x))))


@jax.jit
def adapted(metric, bends, noise):
    """To a Hessian that is diagonal in units of the width."""
    return metric.adapted(lambda v: bends * v, bends, jnp.asarray(noise, bends.dtype))


def settled(hessian, metric):
    """The metric after many steps on one Hessian, without noise."""

    @jax.jit
    def advanced(metric):
        def advance(_, metric):
            product = lambda v: jnp.matmul(metric.matrix.T, hessian @ (metric.matrix @ v))
            whole = metric.matrix.T @ hessian @ metric.matrix
            return metric.adapted(product, jnp.diagonal(whole), jnp.zeros(()))[0]

        return jax.lax.fori_loop(0, 60, advance, metric)

    return advanced(metric)


def test_widths_follow_the_hessian_to_its_inverse_root(x64):
    hessian = symmetric(0, np.array([0.1, 1.0, 30.0]))[0]
    metric = settled(hessian, METRIC(jnp.array([0.5, 1.0, 2.0]), True))
    matrix = np.asarray(metric.matrix)
    round_ = matrix.T @ hessian @ matrix
    np.testing.assert_allclose(round_ / round_[0, 0], np.eye(3), atol=1e-3)
    assert np.linalg.det(matrix) == pytest.approx(1)
    points = np.random.default_rng(0).normal(size=(4, 3))
    for some in (points, points[0]):
        np.testing.assert_allclose(AND_BACK(metric, some), 2 * [some], rtol=1e-9)


def test_many_widths_follow_the_diagonal(x64):
    sizes = np.geomspace(0.1, 10, MOST_DIRECTIONS + 1)
    metric = turn = METRIC(np.full(sizes.size, 0.5), True)
    assert metric.matrix.shape == sizes.shape
    for _ in range(60):
        metric, turn = adapted(metric, sizes * np.asarray(metric.matrix) ** 2, 0.0)
    np.testing.assert_allclose(np.asarray(metric.matrix) * np.sqrt(sizes), 0.5, rtol=1e-3)
    assert np.sum(np.log(np.asarray(metric.matrix) / 0.5)) == pytest.approx(0, abs=1e-9)
    for one in (metric, turn):
        np.testing.assert_allclose(AND_BACK(one, sizes), 2 * [sizes], rtol=1e-9)


@pytest.mark.parametrize(("size", "noise"), [(0.0, 0.0), (1.0, 1e6)], ids=["flat", "noise"])
def test_what_says_nothing_changes_nothing(size, noise, x64):
    metric = METRIC(jnp.array([0.5, 1.0, 2.0]), True)
    after, turn = adapted(metric, size * np.array([1.0, 5.0, -2.0]), noise)
    np.testing.assert_allclose(after.matrix, metric.matrix, atol=1e-5)
    np.testing.assert_allclose(turn.matrix, np.eye(3), atol=1e-5)


def test_points_stay_within_bounds_and_within_reach(dtype):
    rng = np.random.default_rng(0)
    turn, moves = rng.normal(size=(3, 3)), (3 * rng.normal(size=(200, 3))).astype(dtype)
    low, high = np.array([-1, -0.5, -2], dtype), np.array([0.1, 0.6, np.inf], dtype)

    @functools.partial(jax.jit, static_argnums=2)
    def bounded(metric, center, mirror):
        """The points, their moves in units of the width, and those without bounds."""
        place = functools.partial(metric.bounded, center, low=low, high=high, mirror=mirror)
        points = jax.vmap(place)(moves)
        return points, metric.into(points - center[None]), metric.out(moves)

    # the first center is inside, the second in a corner
    for center in (np.zeros(3, dtype), np.array([0.1, -0.5, 0], dtype)):
        for matrix in (turn, turn * np.array([1, 1e-3, 1])):
            metric = Metric(*(jnp.asarray(a, dtype) for a in (matrix, np.linalg.inv(matrix))))
            for mirror in (False, True):
                points, into, free = map(np.asarray, bounded(metric, center, mirror))
                assert np.all((points >= low) & (points <= high))
                reach = np.linalg.norm(into, axis=1)
                assert np.all(reach <= 1.101 * np.linalg.norm(moves, axis=1))
                # a step never turns round; of the samples in a narrow valley some do
                turned = np.any((points - center) * free < -1e-6)
                assert mirror or not turned
        plain = METRIC(np.array([0.5, 1, 2], dtype), False)
        points, _, free = map(np.asarray, bounded(plain, center, True))
        np.testing.assert_array_equal(points, np.clip(center + free, low, high))
