"""The higher-order-rendering paper's methods: its rules, its counts, and its tasks in its units."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import _registry
from benchmarks._loop import Counter, Stop
from benchmarks._task import Budget, Problem
from benchmarks.methods import _pairs, higher_order
from benchmarks.methods._flat import Flat
from benchmarks.methods.higher_order import _move, _turn
from benchmarks.studies.papers.table import NAMES, PUBLISHED, evaluations, settings
from benchmarks.studies.papers.tasks import TASKS, UNITS
from tests.parts import quick_of

MATRIX = np.array([[10.0, 7.5], [7.5, 10.0]], np.float32)
SOUGHT = np.array([0.7, -0.4], np.float32)
START = jnp.array([-0.8, 0.9])


@pytest.fixture(autouse=True)
def standard_promotion():
    """Adam does not run under strict promotion."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def bowl() -> Flat:
    loss = lambda y: (y - SOUGHT) @ MATRIX @ (y - SOUGHT) / 2
    box = np.full(2, -20, np.float32), np.full(2, 20, np.float32)
    return Flat(Problem(box, 1.0, Budget(1000, 60), loss))


def test_conjugate_steps_find_the_minimum_of_a_quadratic_in_as_many_steps_as_dimensions():
    flat, x = bowl(), START
    gradient = jax.jit(jax.grad(flat.loss))
    r = v = -gradient(x)
    for _ in range(2):
        x, _ = _move(flat, x, v, gradient(x), MATRIX @ v, 100.0)
        new = -gradient(x)
        r, v = new, _turn(r, v, new, False)[0]
    assert x == pytest.approx(SOUGHT, abs=1e-5)


@pytest.mark.parametrize("curvature", [-1.0, 0.0])
def test_where_the_curvature_is_not_positive_a_step_is_as_small_as_the_slope(curvature):
    v = jnp.array([3.0, 4.0])
    for slope in (1e-3, -1e-3):
        x, squared = _move(bowl(), jnp.zeros(2), v, slope * v, curvature * v, 0.5)
        assert x == pytest.approx(-slope * 25 * np.asarray(v))
        assert squared == pytest.approx((slope * 25 * 5) ** 2)
    # and never longer than the radius
    x, squared = _move(bowl(), jnp.zeros(2), v, v, curvature * v, 0.5)
    assert x == pytest.approx(-0.1 * np.asarray(v))
    assert squared == pytest.approx(0.25)


def test_a_direction_that_does_not_lead_down_is_left():
    r, new = jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0])
    assert _turn(r, jnp.array([1.0, 0.0]), new, False)[1].item() is False
    for v, restart in (([0.0, -9.0], False), ([1.0, 0.0], True)):
        turned, again = _turn(r, jnp.array(v), new, restart)
        assert again
        assert turned == pytest.approx([0, 1])


SLOPES = [("elements", 1), ("aggregate", 2), ("aggregate", 4)]


@pytest.mark.parametrize("case", quick_of(SLOPES, SLOPES[1:2]), ids=str)
def test_slopes_are_those_of_the_smoothed_loss(case, key):
    slope, pairs = case
    flat = bowl()
    one = higher_order.SLOPES[slope](flat, pairs)
    many = jax.jit(jax.vmap(lambda key: one(key, jnp.float32(0.3), START)))
    found = np.asarray(many(jax.random.split(key, 4000)))
    error = np.std(found, 0) / np.sqrt(len(found))
    true = MATRIX @ (np.asarray(START) - SOUGHT)  # smoothing does not change a quadratic's slope
    assert np.all(np.abs(np.mean(found, 0) - true) < 4 * error)


def test_a_derivative_without_pairs_takes_its_share_of_the_others(key):
    """With one pair in two dimensions: half of the time its own, else half of the other's."""
    one = _pairs.aggregate(bowl(), 1)
    many = jax.jit(jax.vmap(lambda key: one(key, jnp.float32(0.3), START)))
    found = np.asarray(many(jax.random.split(key, 20_000)))
    true = MATRIX @ (np.asarray(START) - SOUGHT)
    assert np.mean(found, 0) == pytest.approx(0.75 * true, rel=0.15)


def test_fischers_slope_sees_all_parameters_at_once(key):
    """Of a linear function: every parameter's slope, in the mean, by the signs alone."""
    line = lambda y: 3 * y[0] - 2 * y[1]
    box = np.full(2, -20, np.float32), np.full(2, 20, np.float32)
    one = _pairs.fischer(Flat(Problem(box, 1.0, Budget(10, 60), line)), 1)
    many = jax.jit(jax.vmap(lambda key: one(key, jnp.float32(0.5), jnp.zeros(2))))
    found = np.asarray(many(jax.random.split(key, 4000)))
    assert np.mean(found, 0) == pytest.approx([3, -2], rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_an_iteration_takes_the_evaluations_of_table_3_each_pair_counted_twice(name):
    task, counter, counts = TASKS["quad"](), Counter(), []

    def record(y):
        jax.block_until_ready(y)
        counts.append(counter.evaluations)
        if len(counts) == 3:
            raise Stop

    said = settings("quad", name, 1.0)
    if "tolerance" in said:
        said["tolerance"] = 0.0  # every step of the line search
    solve = _registry.method(name).prepare(counter.watched(task.problem), **said)
    with pytest.raises(Stop):
        solve(task.start(0), jax.random.key(0), record)
    assert {b - a for a, b in itertools.pairwise(counts)} == {evaluations("quad", name, 2)}


def test_counts_of_table_3_in_ten_dimensions():
    assert evaluations("box10", "fischer_fr22", 10) == 12
    assert evaluations("box10", "wang_g", 10) == 120
    assert evaluations("box10", "wang_h", 10) == 12 * (3 * (55 + 10) + 10)
    assert evaluations("box10", "wang_hvp", 10) == 12 * (3 * 30 + 10)
    assert evaluations("box10", "wang_hvpa", 10) == 12 * (3 * 3 + 1)


def test_settings_are_in_units_of_the_first_sigma():
    said = settings("mug", "fischer_fr22", 1.0)
    assert said["rate"] == pytest.approx(0.1 / 3)
    assert said["sigma_end"] == pytest.approx(0.01 / 3)
    assert settings("mug", "wang_hvpa", 1.0)["trust"] == 4
    assert settings("mug", "wang_h", 1.0)["trust"] == 1  # 3 units
    for task, published in PUBLISHED.items():
        for name in published.rows:
            assert all(value > 0 for value in settings(task, name, UNITS.get(task, 1.0)).values())


def test_starts_are_where_the_authors_have_them():
    quad, box2, box10 = (TASKS[name]() for name in ("quad", "box2", "box10"))
    loss = jax.jit(box2.problem.loss)
    for seed in range(5):
        y = np.asarray(quad.start(seed))
        assert np.all((y >= 800) & (y <= 1000))
        # on a plateau: the square does not touch the one that is sought
        y = np.asarray(box2.start(seed))
        moved = loss(y + np.array([2, -2], np.float32))
        assert loss(y) == pytest.approx(float(moved), rel=1e-2)
        assert np.all(np.abs(np.asarray(box10.start(seed)) - 250) < 60)
    for task in (quad, box2, box10):
        assert task.problem.loss(jnp.asarray(task.score.reference)) == 0
