"""Within bounds a search looks elsewhere once: what is found there, and what it costs."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import smoothdiff as sd
from smoothdiff._params import take_apart
from smoothdiff._solvers._fall import Fall, much
from smoothdiff._solvers._look import Look
from smoothdiff._solvers._stages import LOOK, TRUST, WIDE
from tests.parts import quick_of

LOW, HIGH = jnp.zeros(2), jnp.ones(2)
BASIN, DIP, START = jnp.array([0.3, 0.35]), jnp.array([0.95, 0.95]), jnp.array([0.93, 0.93])


def residuals(y, args=None):
    """A basin over most of the box, and a dip that is not as low in its corner."""
    dip, basin = jnp.append((y - DIP) / 5, 1.1), jnp.append(y - BASIN, 0.0)
    return jnp.where(jnp.all(y > 0.85), dip, basin)


def loss(y, args=None):
    return jnp.sum(residuals(y) ** 2)


CASES = [(sd.minimise, sd.NewtonCG, loss), (sd.least_squares, sd.GaussNewton, residuals)]
each = pytest.mark.parametrize(("call", "solver", "fun"), CASES, ids=["number", "residuals"])


def watched(fun, points):
    """The function, with all points that it was evaluated at, the first call included."""

    def seen(y):
        points.append(np.asarray(y))
        return np.asarray(fun(y))

    out = jax.eval_shape(fun, START)
    box = sd.black_box(seen, jax.ShapeDtypeStruct(out.shape, out.dtype))
    return lambda y, args: box(y)


@pytest.mark.parametrize("seed", quick_of(range(3), [0]))
@pytest.mark.parametrize("case", quick_of(range(2), [0]), ids=["number", "residuals"])
def test_a_poor_minimum_is_left(case, seed):
    call, solver, fun = CASES[case]
    key = jax.random.key(seed)
    stays = call(fun, START, solver=solver(0.01), key=key)
    np.testing.assert_allclose(stays.y, DIP, atol=0.01)
    left = call(fun, START, solver=solver(0.01), key=key, bounds=(LOW, HIGH))
    assert left.reason == "converged"
    np.testing.assert_allclose(left.y, BASIN, atol=1e-3)


def test_of_one_parameter_the_lowest_of_many_valleys_is_found():
    valleys = lambda y, at: 2 * (y - at) ** 2 + 0.5 * (1 - jnp.cos(15 * (y - at)))
    evaluations = []
    for seed, (start, at) in enumerate(np.random.default_rng(0).uniform(0.05, 0.95, (20, 2))):
        result = sd.minimise(valleys, start, at, key=jax.random.key(seed), bounds=(0.0, 1.0))
        np.testing.assert_allclose(result.y, at, atol=0.01)
        evaluations.append(result.evaluations)
    assert np.median(evaluations) < 60


@pytest.mark.parametrize("seed", quick_of(range(5), [0]))
def test_a_minimum_with_a_kink_is_left(seed):
    """Wide samples around it find nothing: the look comes while they still go on."""

    def fun(y, args):
        # half of the box is lower than the kink
        kink = 0.5 + jnp.sum(jnp.abs(y - 0.8))
        return jnp.where(jnp.all(y > 0.6), kink, jnp.sum(jnp.abs(y - BASIN)))

    start, key = jnp.array([0.7, 0.75]), jax.random.key(seed)
    left = sd.minimise(fun, start, key=key, bounds=(LOW, HIGH))
    np.testing.assert_allclose(left.y, BASIN, atol=1e-3)


def valley(y, args=None):
    """One that gains little for long, beside a lower basin."""
    shallow = 1 + jnp.abs(y[1] - 0.9) + 1e-3 * (y[0] - y[1]) ** 2
    return jnp.where(y[1] > 0.8, shallow, jnp.sum((y - BASIN) ** 2))


@pytest.mark.parametrize("seed", quick_of(range(3), [1]))
def test_where_the_function_hardly_falls_the_look_comes_at_once(seed):
    """Nobody goes to the end of a long valley first."""
    points = []
    solver, key = sd.NewtonCG(0.05), jax.random.key(seed)
    call = watched(valley, points)
    start = jnp.array([0.1, 0.95])
    found = sd.minimise(call, start, solver=solver, key=key, bounds=(LOW, HIGH))
    np.testing.assert_allclose(found.y, BASIN, atol=1e-3)
    there = np.linalg.norm(np.array(points) - np.asarray(BASIN), axis=1) < 0.1
    assert np.any(there[:40])


@pytest.mark.slow
@pytest.mark.parametrize("history", [None, 4])
@pytest.mark.parametrize("at_once", [1, 16])
def test_no_look_comes_before_the_models_had_their_steps(history, at_once):
    """Points beside a step are no sign, nor is a history that is soon full of them."""
    solver, key = sd.NewtonCG(0.05, history=history), jax.random.key(0)
    bounds = np.zeros(2), np.ones(2)
    search = sd.Search(np.array([0.1, 0.95]), solver=solver, key=key, bounds=bounds)
    stages = []
    while LOOK not in stages and len(stages) < 100:
        points = [np.asarray(point) for point in search.ask(at_once)]
        search.tell(points, [np.asarray(valley(point)) for point in points])
        stages.append(int(search._state.search.stage))
    assert LOOK in stages
    assert stages.count(TRUST) + at_once * stages.count(WIDE) >= 12


def fallen(fall, fun, usual, dtype=jnp.float32):
    """After another evaluation."""
    fun, usual = jnp.asarray(fun, dtype), jnp.asarray(usual, dtype)
    return fall.after(fun, much(fun, usual), 1)


def test_a_fall_is_much_beside_the_value_and_beside_others():
    fall = fallen(Fall.start(jnp.ones(())), 100.0, 1e6)
    assert (float(fall.to), int(fall.since)) == (100.0, 0)
    # little by little it becomes much
    for fun, to, since in [(99.5, 100, 1), (99.1, 100, 2), (98.9, 98.9, 0), (98.9, 98.9, 1)]:
        fall = fallen(fall, fun, 1e6)
        assert (float(fall.to), int(fall.since)) == (pytest.approx(to), since)
    # one percent of the value is not asked for where others are hardly higher
    assert int(fallen(fall, 98.8, 100.0).since) == 0
    # nor is anything less where the value is zero
    assert int(fallen(fall, 0.0, 1e6).since) == 0
    assert not fall.long_ago(2, 1)
    later = dataclasses.replace(fall, since=jnp.asarray(12))
    assert later.long_ago(2, 1)
    assert not later.long_ago(2, 4)  # four steps of four


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_where_nothing_is_known_nothing_fell(dtype):
    with jax.enable_x64(dtype == jnp.float64):
        fall = Fall.start(jnp.zeros((), dtype))
        for _ in range(3):
            fall = fallen(fall, jnp.inf, jnp.nan, dtype)
        assert (float(fall.to), int(fall.since), fall.since.dtype) == (jnp.inf, 3, jnp.int32)
        known = fallen(fall, 2.0, 3.0, dtype)
        assert (float(known.to), int(known.since)) == (2.0, 0)
        assert known.to.dtype == dtype


@pytest.mark.slow
def test_a_look_that_finds_nothing_breaks_into_no_round():
    """Several points of a round are asked for at once: after the look none comes again."""
    stairs = lambda y: np.sum(np.floor(300 * np.abs(y - 0.3)))
    both = 0
    for seed in range(6):
        start = np.random.default_rng(seed).random(2)
        search = sd.Search(start, key=jax.random.key(seed), bounds=(LOW, HIGH))
        rounds, stages = [], []
        while not search.done and len(stages) < 50:
            stages.append(int(search._state.search.stage))
            points = [np.asarray(point) for point in search.ask(4)]
            search.tell(points, [stairs(point) for point in points])
            if stages[-1] == WIDE:
                rounds += points
        looks = stages.index(LOOK) if LOOK in stages else len(stages)
        both += WIDE in stages[:looks] and WIDE in stages[looks:]
        assert not rounds or len(rounds) == len(np.unique(rounds, axis=0))
    assert both > 0  # rounds before and after a look


@pytest.mark.slow
@each
def test_it_is_left_under_optimistix_too(call, solver, fun):
    run = optx.minimise if call is sd.minimise else optx.least_squares
    options = {"key": jax.random.key(0), "bounds": (LOW, HIGH)}
    # how many steps it takes hangs on rounding; that it ends by itself does not
    found = run(fun, solver(0.01), START, options=options, max_steps=2000)
    assert found.result == optx.RESULTS.successful
    np.testing.assert_allclose(found.value, BASIN, atol=1e-3)


@pytest.mark.slow
@each
def test_it_is_left_by_asking_and_telling(call, solver, fun):
    settings = {"key": jax.random.key(0), "bounds": (LOW, HIGH), "residuals": solver.squares}
    search = sd.Search(START, solver=solver(0.01), **settings)
    for _ in range(400):
        if search.done:
            break
        points = search.ask(3)
        search.tell(points, [np.asarray(fun(point)) for point in points])
    assert search.done
    np.testing.assert_allclose(search.y, BASIN, atol=1e-3)


def left_over(y):
    """Residuals of which most of the loss cannot go away."""
    return jnp.append(y - BASIN, 1.0)


bowl = lambda y: jnp.sum((y - BASIN) ** 2)
ENDS = [
    (sd.minimise, sd.NewtonCG, bowl, 9),
    (sd.least_squares, sd.GaussNewton, left_over, 9),
    (sd.least_squares, sd.GaussNewton, lambda y: y - BASIN, 0),
]


@pytest.mark.slow
@pytest.mark.parametrize("end", range(3), ids=["number", "much", "none"])
def test_a_good_minimum_costs_a_few_points(end):
    call, solver, fun, more = ENDS[end]
    runs = []
    for bounds in ((-jnp.inf, jnp.inf), (LOW, HIGH)):
        points = []
        result = call(
            watched(fun, points),
            jnp.array([0.5, 0.5]),
            solver=solver(0.1, rtol=1e-2),
            key=jax.random.key(0),
            bounds=bounds,
        )
        assert result.reason == "converged"
        np.testing.assert_allclose(result.y, BASIN, atol=0.01)
        runs.append(np.array(points))
    known, all_points = runs
    assert len(all_points) == len(known) + more
    apart = ~np.all(np.isclose(all_points[: len(known)], known, atol=1e-5), axis=1)
    first = np.argmax(apart) if more else len(known)
    looked, rest = np.split(all_points, [first, first + more])[1:]
    np.testing.assert_allclose(rest, known[first:], atol=1e-5)
    if more:  # to both sides of the middle
        assert np.all((looked >= 0) & (looked <= 1))
        assert np.all((looked.min(0) < 0.5) & (looked.max(0) > 0.5))


@pytest.mark.slow
@each
def test_where_a_bound_is_open_nobody_looks(call, solver, fun):
    points = []
    for high in (HIGH, jnp.array([1.0, jnp.inf])):
        points.append([])
        result = call(
            watched(fun, points[-1]),
            START,
            solver=solver(0.01),
            key=jax.random.key(0),
            bounds=(LOW, high),
        )
        assert result.reason == "converged"
    np.testing.assert_allclose(result.y, DIP, atol=0.01)
    assert np.min(points[0]) < 0.5 < np.min(points[1])


@pytest.mark.slow
def test_a_zero_of_all_residuals_ends_a_look():
    points = []
    dip = lambda y: jnp.where(jnp.all(y > 0.85), jnp.append((y - DIP) / 5, 1.1), jnp.zeros(3))
    fun = watched(dip, points)
    settings = {"solver": sd.GaussNewton(0.01), "key": jax.random.key(0), "bounds": (LOW, HIGH)}
    result = sd.least_squares(fun, START, **settings)
    assert (result.reason, result.fun) == ("converged", 0)
    # the first that is nobody else's point, and the judgement
    assert np.sum(np.any(np.array(points) < 0.8, axis=1)) == 2


@pytest.mark.parametrize(
    ("call", "solver", "fun"),
    [
        pytest.param(*CASES[0], id="number", marks=pytest.mark.slow),
        pytest.param(*CASES[1], id="residuals"),
    ],
)
def test_failures_elsewhere_end_nothing(call, solver, fun):
    fails = lambda y, args: jnp.where(jnp.all(y > 0.85), fun(y), jnp.nan)
    result = call(fails, START, solver=solver(0.01), key=jax.random.key(0), bounds=(LOW, HIGH))
    assert result.reason == "converged"
    np.testing.assert_allclose(result.y, DIP, atol=0.01)


@pytest.mark.slow
@each
def test_several_points_at_once(call, solver, fun):
    result = call(
        fun, START, solver=solver(0.01, num_samples=4), key=jax.random.key(0), bounds=(LOW, HIGH)
    )
    np.testing.assert_allclose(result.y, BASIN, atol=1e-3)


def test_a_limit_ends_a_look():
    points = []
    fun = watched(bowl, points)
    settings = {"solver": sd.NewtonCG(0.2), "key": jax.random.key(0), "bounds": (LOW, HIGH)}
    whole = sd.minimise(fun, START, **settings)
    # two evaluations judge the answer, and before them come the five of the look
    limit = whole.evaluations - 3
    assert all(np.linalg.norm(point - BASIN) > 0.1 for point in points[limit - 4 : limit + 1])
    result = sd.minimise(fun, START, max_evaluations=limit, **settings)
    assert result.reason == "max_evaluations"
    assert result.evaluations == limit
    np.testing.assert_allclose(result.y, BASIN, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["line", "logarithm", "root"])
def test_a_function_that_falls_for_ever_has_not_converged(name):
    """So far from the start that differences are rounding, a point twice as far is lower."""
    falls = {
        "line": lambda y, args: -jnp.sum(y),
        "logarithm": lambda y, args: -jnp.sum(jnp.log1p(jnp.abs(y))),
        "root": lambda y, args: -jnp.sum(jnp.sqrt(jnp.abs(y))),
    }
    for start in (jnp.zeros(2), jnp.full(2, 0.5)):
        ran = [sd.minimise(falls[name], start, key=jax.random.key(seed)) for seed in range(3)]
        assert np.median([found.fun for found in ran]) < -50
        assert all(found.result != optx.RESULTS.successful for found in ran)


@pytest.mark.slow
def test_a_minimum_far_away_is_found_and_looked_beyond():
    """At 1e6 sigmas it begins anew, and a point beyond is higher; a near one has none."""
    points = []
    for place in (1e6, 1.0):
        bowl = watched(lambda y, place=place: jnp.sum((y / place - 1) ** 2), points)
        found = sd.minimise(bowl, jnp.zeros(2), key=jax.random.key(0), solver=sd.NewtonCG(1.0))
        assert found.reason == "converged"
        np.testing.assert_allclose(found.y, place, rtol=1e-3)
    beyond = np.all(np.abs(np.array(points) - 2e6) < 1e4, axis=1)
    assert 1 <= np.sum(beyond) <= 2


def test_the_last_points_change_one_parameter_each():
    params = take_apart(jnp.zeros(3), 1.0, (-1.0, 1.0))
    best, samples = jnp.array([0.5, -0.25, 0.125]), jax.random.normal(jax.random.key(0), (10, 3))
    look = Look.start(best)
    # more are asked for than there are
    points = np.asarray(jax.jit(lambda: look.points(params, best, lambda count: samples, 11))())
    changed = points != np.asarray(best)
    assert np.all(np.sum(changed[:7], axis=1) == 3)
    np.testing.assert_array_equal(changed[7:10], np.eye(3, dtype=bool))
    np.testing.assert_array_equal(points[10], points[9])
