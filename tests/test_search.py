"""Asking and telling: the steps of the solvers, in any order, with points missing or failed."""

import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import smoothdiff as sd
from smoothdiff._solvers._stages import LOOK
from tests.parts import quick_of

KEY = jax.random.key(0)
START = np.array([-1.2, 1.0], np.float32)


def valley(y):
    return np.array([10 * (y[1] - y[0] ** 2), 1 - y[0]], np.float32)


def squares(y):
    return np.float32(valley(y) @ valley(y))


def evaluated(run, fun, shape, **settings):
    """The points that a run evaluates, but for its judgement."""
    points = []

    def host(y):
        points.append(np.array(y))
        return fun(y)

    box = sd.black_box(host, jax.ShapeDtypeStruct(shape, jnp.float32))
    result = run(lambda y, _: box(y), START, key=KEY, **settings)
    return points[: len(result.history)]


@pytest.mark.parametrize(
    ("run", "fun", "shape"),
    [
        (sd.least_squares, valley, (2,)),
        pytest.param(sd.minimise, squares, (), marks=pytest.mark.slow),
    ],
)
def test_one_at_a_time_these_are_the_steps_of_the_solvers(run, fun, shape):
    expected = evaluated(run, fun, shape, sigma=0.3, max_steps=30)
    search = sd.Search(START, key=KEY, residuals=bool(shape), sigma=0.3)
    for point in expected:
        (asked,) = search.ask()
        np.testing.assert_array_equal(asked, point)
        search.tell([asked], [fun(asked)])
    assert search.evaluations == len(expected)
    assert search.fun == min(0.5 * squares(y) if shape else fun(y) for y in expected)


@pytest.mark.parametrize("workers", [3, pytest.param(8, marks=pytest.mark.slow)])
def test_points_come_in_any_order_or_never_or_fail(workers):
    """Workers that take a random time; one of ten points is never told, one of ten is NaN."""
    rng, out = np.random.default_rng(workers), []
    search = sd.Search(START, key=KEY, residuals=True, sigma=0.3)
    while search.fun > 1e-4 and search.evaluations < 300:
        out += search.ask(workers - len(out))
        point = out.pop(rng.integers(len(out)))
        fate = rng.uniform()
        if fate > 0.1:
            search.tell([point], [valley(point) if fate > 0.2 else np.nan])
    assert search.fun <= 1e-4
    assert search.fun == pytest.approx(0.5 * squares(search.y))


def test_a_search_that_was_pickled_goes_on_as_if_it_was_not():
    """With one point out, and one told before its turn."""
    search = sd.Search(START, key=KEY, residuals=True, sigma=0.3)
    _, second = search.ask(2)
    search.tell([second], [valley(second)])
    again = pickle.loads(pickle.dumps(search))
    for _ in range(3):
        (point,), (same,) = search.ask(), again.ask()
        np.testing.assert_array_equal(point, same)
        for each in (search, again):
            each.tell([point], [valley(point)])
    assert (search.fun, search.evaluations) == (again.fun, 4) == (again.fun, again.evaluations)
    within = sd.Search(START, key=KEY, residuals=True, space=sd.Range(-3, 3))
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(within)).y, within.y)


def test_what_is_asked_for_is_new():
    search = sd.Search(START, key=KEY, sigma=0.3)
    first = search.ask(10)
    assert len({point.tobytes() for point in first + search.ask(5)}) == 15
    search.tell(first[::-1], [squares(y) for y in first[::-1]])
    assert not {point.tobytes() for point in first} & {point.tobytes() for point in search.ask(4)}


def test_a_search_that_is_told_the_same_again_goes_on_where_it_was():
    search, told = sd.Search(START, key=KEY, residuals=True, sigma=0.3), []
    for _ in range(8):
        points = search.ask(2)
        told += [(points, [valley(y) for y in points])]
        search.tell(*told[-1])
    again = sd.Search(START, key=KEY, residuals=True, sigma=0.3)
    for points, values in told:
        again.tell(points, values)
    np.testing.assert_array_equal(again.ask(), search.ask())
    assert (again.fun, again.evaluations) == (search.fun, search.evaluations)


def test_earlier_evaluations_teach():
    rng = np.random.default_rng(0)
    earlier = [np.float32(rng.uniform(-2, 2, 2)) for _ in range(20)]
    search = sd.Search(START, key=KEY, residuals=True, sigma=0.3)
    search.tell(earlier, [valley(y) for y in earlier])
    assert search.evaluations == 20
    assert search.fun == min(0.5 * squares(y) for y in earlier)
    assert not search.done
    # one that is repeated does no harm
    search.tell(earlier[:1], [valley(earlier[0])])
    assert np.isfinite(search.ask(3)).all()


@pytest.mark.slow
def test_a_space_is_asked_for_natural_values():
    space = {"rate": sd.Range(1e-4, 1e2, log=True), "teeth": sd.Integer(3, 20)}
    y0 = {"rate": np.float32(0.01), "teeth": 7}
    search = sd.Search(y0, key=KEY, residuals=True, space=space)

    def fun(y):
        assert np.asarray(y["teeth"]).dtype.kind == "i"
        return np.array([np.log(y["rate"]), 0.3 * (y["teeth"] - 12)], np.float32)

    for _ in range(60):
        points = search.ask(2)
        search.tell(points, [fun(y) for y in points])
    assert search.fun < 1e-3
    assert int(search.y["teeth"]) == 12


@pytest.mark.slow
def test_bounds_hold():
    bounds = np.array([-1.5, 0.5], np.float32), np.array([0.5, 2.0], np.float32)
    search = sd.Search(START, key=KEY, bounds=bounds)
    for _ in range(15):
        points = search.ask(4)
        assert all(np.all((bounds[0] <= y) & (y <= bounds[1])) for y in points)
        search.tell(points, [squares(y) for y in points])


@pytest.mark.parametrize(
    ("call", "error", "match"),
    [
        (lambda: sd.Search(jnp.zeros(100), key=KEY), TypeError, "fewer than 100"),
        (
            lambda: sd.Search(START, key=KEY, solver=sd.GaussNewton(0.1)),
            TypeError,
            "residuals=True",
        ),
        (
            lambda: sd.Search(START, key=KEY).tell([START], [1.0, 2.0]),
            ValueError,
            "1 points but 2 values",
        ),
        (
            lambda: sd.Search(START, key=KEY).tell([START], [valley(START)]),
            ValueError,
            "tell one number",
        ),
        (
            lambda: sd.Search(START, key=KEY, solver=sd.NewtonCG(0.1)).tell([START], [np.nan]),
            ValueError,
            'nonfinite="drop"',
        ),
    ],
)
def test_wrong_arguments_are_told_what_to_write(call, error, match):
    with pytest.raises(error, match=match):
        call()


@pytest.mark.slow
def test_there_is_always_another_point():
    """Also where the radius has come to nothing, so that a point within it is one that is known."""
    search = sd.Search(jnp.zeros(2), key=KEY)
    for _ in range(25):
        points = search.ask(2)
        assert len({point.tobytes() for point in points}) == 2
        search.tell(points, [(y[0] - 1) ** 2 + (y[1] + 2) ** 2 for y in points])
    np.testing.assert_array_equal(search.y, [1, -2])


@pytest.mark.slow
def test_bounds_far_away_change_nothing():
    """Points are told apart by rounding, whose size is not that of the box."""
    valley = lambda y: np.array([10 * (y[1] - y[0] ** 2), 1 - y[0]], np.float32)
    took = []
    for far in (1e3, 1e5):
        settings = {"solver": sd.GaussNewton(0.1), "residuals": True, "bounds": (-far, far)}
        search = sd.Search(jnp.array([-1.2, 1.0]), key=jax.random.key(2), **settings)
        while search.fun > 1e-5 and search.evaluations < 200:
            points = search.ask(3)
            search.tell(points, [valley(point) for point in points])
        took.append(search.evaluations)
    assert took[0] == took[1] < 100


@pytest.mark.parametrize("bounds", quick_of([None, (0.0, np.inf)], [(0.0, np.inf)]))
def test_a_search_without_a_box_may_look_further_on(bounds):
    """Where it went a million sigmas, whether it has run off is to be seen."""
    search = sd.Search(jnp.zeros(1), key=jax.random.key(0), sigma=1e-6, bounds=bounds)
    looked = lambda: int(search._state.search.stage) == LOOK
    while not search.done and search.evaluations < 150:
        if looked():  # a point that nobody asked for is not the one that the look wants
            search.tell([np.array([0.123])], [(0.123 - 1) ** 2])
            assert looked()
        points = search.ask(2)
        search.tell(points, [(y[0] - 1) ** 2 for y in points])
    assert search.done
    assert search.y[0] == pytest.approx(1)


@pytest.mark.slow
def test_eight_points_of_each_round_are_as_good_as_num_samples(x64):
    """Ten evaluations determine a quadratic of three parameters."""
    bend = np.array([[1.0, 0.3, 0.0], [0.0, 2.0, 0.5], [0.0, 0.0, 0.7]])
    fun = lambda y: float(np.sum((bend @ (np.asarray(y) - [1.0, -0.5, 2.0])) ** 2))
    rounds = []
    for seed in range(5):
        search = sd.Search(np.random.default_rng(seed).random(3), key=jax.random.key(seed))
        rounds.append(0)
        while rounds[-1] < 30 and not search.fun < 1e-10:
            points = search.ask(8)
            search.tell(points, [fun(y) for y in points])
            rounds[-1] += 1
    assert np.median(rounds) <= 6
