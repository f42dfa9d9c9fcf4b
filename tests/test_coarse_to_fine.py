"""From coarse to fine: what is found, what it costs, and where it ends."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import smoothdiff as sd
from tests.closed_forms import as_users_have_it

KEY = jax.random.key(0)


def bars(pixels: int) -> sd.Level:
    """Two bars on a line: places 0.62 and 0.31 are sought."""
    x = (np.arange(pixels) + 0.5) / pixels

    def draw(y):
        inside = np.abs(x[:, None] - np.asarray(y)[None]) < np.array([[0.1, 0.05]])
        return inside @ np.array([1.0, 0.6])

    photo = draw([0.62, 0.31])
    scale = np.sqrt(1 / pixels)
    residuals = sd.black_box(
        lambda y: scale * (draw(y) - photo), jax.ShapeDtypeStruct((pixels,), jnp.float32)
    )
    return sd.Level(lambda y, args: residuals(y), float(pixels))


def sine(cost: float) -> sd.Level:
    """A level of this cost."""
    return sd.Level(lambda y, args: jnp.sin(y), cost)


class Counted:
    """A level whose calls are counted where they are evaluated."""

    def __init__(self, fun, cost, out):
        self.calls = 0

        def call(y):
            self.calls += 1
            return fun(y)

        box = sd.black_box(call, jax.ShapeDtypeStruct(out, jnp.float32))
        self.level = sd.Level(lambda y, args: box(y), cost)


def bowls() -> list[Counted]:
    """A bowl, and two that are like it."""
    fun = lambda tilt: lambda y: np.asarray([y[0] - 1 + tilt, 3 * (y[1] + 2)], np.float32)
    return [Counted(fun(tilt), cost, (2,)) for tilt, cost in ((0.3, 1.0), (0.1, 4.0), (0.0, 64.0))]


@pytest.mark.slow
def test_the_answer_of_the_finest_level_at_a_fraction_of_its_cost():
    """One of five may end in the other minimum, within two standard errors."""
    levels, keys = [bars(16), bars(512)], [jax.random.key(seed) for seed in range(30)]
    start, costs, right = jnp.array([0.45, 0.35]), [], []
    for key in keys:
        found = sd.coarse_to_fine(sd.least_squares, levels, start, key=key, bounds=(0.0, 1.0))
        assert len(found.levels) == len(found.evaluations) == 2
        assert found.fun == found.levels[-1].fun
        there = np.all(np.abs(np.asarray(found.y) - [0.62, 0.31]) < 2 / 512)
        assert there == (found.fun < 1e-3)
        right.append(there)
        costs.append(found.cost)
    assert np.mean(right) > 0.8 - 2 * (0.8 * 0.2 / len(keys)) ** 0.5
    alone = [sd.least_squares(levels[-1].fun, start, key=k, bounds=(0.0, 1.0)) for k in keys[:5]]
    assert np.median(costs) < 0.7 * np.median([found.evaluations for found in alone])


@pytest.mark.slow
def test_all_evaluations_are_counted_and_paid_for():
    counted = bowls()
    levels = [each.level for each in counted]
    found = sd.coarse_to_fine(sd.least_squares, levels, jnp.array([3.0, 3.0]), key=KEY)
    np.testing.assert_allclose(found.y, [1, -2], atol=1e-3)
    calls = [each.calls for each in counted]
    assert list(found.evaluations) == calls  # the start's once more at the end
    assert found.cost == pytest.approx(calls[0] / 64 + calls[1] / 16 + calls[2])


@pytest.mark.slow
def test_one_level_is_the_minimiser_itself():
    level, start = bowls()[-1].level, jnp.array([3.0, 3.0])
    found = sd.coarse_to_fine(sd.least_squares, [level], start, key=KEY)
    key = jax.random.fold_in(KEY, 0)
    alone = sd.least_squares(level.fun, start, key=key)
    np.testing.assert_array_equal(found.y, alone.y)
    assert found.cost == alone.evaluations == found.evaluations[0]


@pytest.mark.slow
def test_a_number_goes_from_coarse_to_fine():
    def rippled(ripple):
        return lambda y, args: jnp.sum(y**2) + ripple * jnp.sum(jnp.sin(40 * y) ** 2)

    levels = [sd.Level(rippled(0.0), 1.0), sd.Level(rippled(0.05), 50.0)]
    start = jnp.array([1.7, -1.2])
    found = sd.coarse_to_fine(sd.minimise, levels, start, key=KEY)
    assert found.fun < 1e-3


@pytest.mark.slow
def test_levels_that_mislead_are_no_worse_than_the_start():
    far = sd.Level(lambda y, args: y - 40.0, 1.0)
    # a narrow hole at the start, and nothing else to see
    hole = sd.Level(lambda y, args: jnp.where(jnp.abs(y - 0.2) < 0.5, y - 0.1, 7.0), 10.0)
    found = sd.coarse_to_fine(sd.least_squares, [far, hole], jnp.zeros(1), key=KEY)
    assert found.fun <= 0.005
    assert len(found.levels) >= 2


@pytest.mark.parametrize("budget", [1.0, 8.0, 20.0])
def test_costs_never_exceed_their_limit(budget):
    counted = bowls()
    levels = [each.level for each in counted]
    start = jnp.array([3.0, 3.0])
    found = sd.coarse_to_fine(sd.least_squares, levels, start, key=KEY, max_cost=budget)
    assert found.cost <= budget
    spent = sum(each.calls * each.level.cost for each in counted) / 64
    assert spent == pytest.approx(found.cost)


def test_a_target_a_callback_and_a_time_end_it():
    levels, start = [each.level for each in bowls()], jnp.array([3.0, 3.0])
    run = lambda **ends: sd.coarse_to_fine(sd.least_squares, levels, start, key=KEY, **ends)
    found = run(target=1e-2)
    assert (found.reason, len(found.levels)) == ("target", 3)
    assert found.fun <= 1e-2
    found = run(callback=lambda record: record.evaluations >= 3)
    assert (found.reason, len(found.levels)) == ("callback", 1)
    assert 3 <= found.evaluations[0] <= 4  # one to judge it
    assert run(max_seconds=0.0).reason == "max_seconds"


def test_it_says_that_the_finest_level_was_too_dear():
    coarse = sd.Level(lambda y, args: (y - 0.1) ** 2, 1.0)
    fine = sd.Level(lambda y, args: (y - 0.7) ** 2, 10.0)
    run = lambda cost: sd.coarse_to_fine(
        sd.minimise, [coarse, fine], 0.65, key=KEY, bounds=(0.0, 1.0), max_cost=cost
    )
    found = run(8.0)
    assert (found.reason, len(found.levels)) == ("max_cost", 1)
    found = run(13.0)
    assert (found.reason, len(found.evaluations)) == ("max_cost", 2)


def test_a_level_that_is_searched_twice_is_counted_as_one():
    """The coarse minimum leads astray: the fine function is lowest at the start, in a hole."""
    calls = [0, 0]

    def level(i, fun):
        def host(y):
            calls[i] += 1
            return np.float32(fun(y))

        box = sd.black_box(host, 0.0)
        return sd.Level(lambda y, args: box(y), (1.0, 10.0)[i])

    hole = lambda y: 10 * (y - 0.7) ** 2 if abs(y - 0.7) < 0.01 else 1 + (y - 0.1) ** 2
    levels = [level(0, lambda y: (y - 0.1) ** 2), level(1, hole)]
    found = sd.coarse_to_fine(sd.minimise, levels, 0.695, key=KEY, bounds=(0.0, 1.0))
    assert len(found.levels) == 3
    np.testing.assert_allclose(found.y, 0.7, atol=1e-2)
    assert list(found.evaluations) == calls
    assert found.cost == pytest.approx(calls[0] / 10 + calls[1])


@pytest.mark.slow
def test_functions_that_take_a_key_have_fresh_noise_at_all_levels():
    """The minimum of one key alone is 0.15 away: each number is a mean of sixteen draws."""
    keys = []

    def level(cost):
        def fun(y, args, key):
            jax.debug.callback(lambda key: keys.append(key.tolist()), jax.random.key_data(key))
            return (y - 1)[None] + 0.6 * jax.random.normal(key, (16, 2))

        return sd.Level(fun, cost)

    levels, off = [level(1.0), level(4.0)], []
    for seed in range(5):
        keys.clear()
        options = {"key": jax.random.key(seed), "takes_key": True, "max_cost": 200}
        found = sd.coarse_to_fine(sd.least_squares, levels, jnp.zeros(2), **options)
        assert len(found.levels) >= 2
        assert len(set(map(tuple, keys))) > 20
        off.append(np.max(np.abs(found.y - 1)))
    assert np.median(off) < 0.075


@pytest.mark.slow
def test_a_space_holds_at_all_levels():
    fun = lambda tilt: lambda y, args: jnp.stack([jnp.log10(y[0]) + 2 + tilt, y[1] - 3.0])
    levels = [sd.Level(fun(0.2), 1.0), sd.Level(fun(0.0), 9.0)]
    space = (sd.Range(1e-4, 1.0, log=True), sd.Range(0.0, 10.0))
    found = sd.coarse_to_fine(sd.least_squares, levels, (0.5, 9.0), key=KEY, space=space)
    np.testing.assert_allclose(jnp.stack(found.y), [0.01, 3.0], rtol=1e-2)


@pytest.mark.parametrize("max_cost", [113.5, 114.0, 114.5, 115.0])
def test_what_was_found_is_returned_at_any_cost(max_cost):
    """A look at the start costs an evaluation before the last search, which then needs room."""
    misleading = sd.Level(lambda y, args: jnp.stack([y - 5.0]), cost=1)
    steps = lambda y, args: jnp.stack([jnp.where(y < 2.5, y - 0.1, y - 2.0)])
    levels = [misleading, sd.Level(steps, cost=4)]
    found = sd.coarse_to_fine(sd.least_squares, levels, 0.2, key=KEY, sigma=0.3, max_cost=max_cost)
    assert found.cost <= max_cost
    assert found.fun <= 0.125  # where the cheaper level has its minimum


def test_a_support_is_for_all_levels():
    target = jnp.linspace(0.2, 0.8, 8)
    steps = lambda count: sd.Level(
        lambda y, args: jnp.floor(count * y) / count - jnp.floor(count * target) / count, cost=count
    )
    found = sd.coarse_to_fine(
        sd.least_squares,
        [steps(8), steps(64)],
        jnp.full(8, 0.5),
        key=KEY,
        support=sd.local_support(0, ndim=1),
        sigma=0.2,
        max_cost=300,
    )
    assert len(found.levels) == 2


def test_steps_are_as_narrow_as_sigma_on_each_level():
    """Of many parameters the first step of Adam is 0.15 sigma in each."""
    bowl = lambda y, args: 1.0 + jnp.sum((y - 1) ** 2)
    levels, start = [sd.Level(bowl, 1), sd.Level(bowl, 64)], jnp.full(120, 0.5)
    search = as_users_have_it(sd.coarse_to_fine)
    found = search(sd.minimise, levels, start, key=KEY, sigma=0.2, max_cost=200)
    coarse, fine = found.levels
    np.testing.assert_allclose(fine.solver.sigma, 0.2 / 8, rtol=1e-6)
    first = np.abs(fine.history[0].y - coarse.y)
    np.testing.assert_allclose(np.max(first) / (0.2 / 8), 0.15, rtol=0.01)


def test_with_a_target_one_search_follows_another_on_the_finest_level():
    """The coarse levels end in one of a hundred local minima."""
    ripples = lambda y, args: jnp.sum(y**2) / 10 + 2 * jnp.sum(1 - jnp.cos(3 * y))
    levels = [sd.Level(ripples, 1), sd.Level(ripples, 4)]
    options = {"key": KEY, "bounds": (-8.0, 12.0), "target": 0.01}
    found = sd.coarse_to_fine(sd.minimise, levels, jnp.array([7.0, 9.0]), **options)
    assert found.reason == "target"
    assert found.fun <= 0.01


def test_switches_are_searched_as_switches_on_each_level():
    """Within bounds, without a sigma, the default for terms of few parameters."""
    lit = jnp.arange(8.0) % 2
    display = sd.Level(lambda y, args: (y > 0.5).astype(float) - lit, 1)
    found = sd.coarse_to_fine(
        sd.least_squares,
        [display, display._replace(cost=2)],
        jnp.full(8, 0.5),
        key=KEY,
        support=sd.local_support(0, ndim=1),
        bounds=(0.0, 1.0),
        max_cost=400,
    )
    assert [type(each.solver) for each in found.levels] == [sd.LocalCrossEntropy] * 2
    assert found.fun == 0


def test_a_solver_that_is_given_is_that_of_all_levels():
    levels = [bowls()[0].level, bowls()[2].level]
    solver = sd.GaussNewton(0.5, num_samples=2)
    found = sd.coarse_to_fine(
        sd.least_squares, levels, jnp.array([3.0, 3.0]), key=KEY, solver=solver
    )
    assert [each.solver.num_samples for each in found.levels[:2]] == [2, 2]
    assert found.levels[0].solver.sigma == 0.5
    assert found.levels[1].solver.sigma < 0.5


@pytest.mark.parametrize(
    ("levels", "options", "error", "message"),
    [
        ([], {}, TypeError, "list of sd.Level"),
        ([lambda y, args: y], {}, TypeError, "list of sd.Level"),
        ([sine(2.0), sine(1.0)], {}, ValueError, "not fall"),
        ([sine(0.0)], {}, ValueError, "positive"),
        ([sine(float("nan"))], {}, ValueError, "positive"),
        ([bowls()[0].level], {"max_evaluations": 10}, ValueError, "max_cost"),
        ([bowls()[0].level], {"max_cost": float("nan")}, ValueError, "max_cost"),
        (
            [bowls()[0].level],
            {"solver": sd.GaussNewton(lambda step: 0.1)},
            ValueError,
            "schedule",
        ),
        ([bowls()[0].level], {"sigma": lambda step: 0.1}, ValueError, "schedule"),
        (
            [bowls()[0].level],
            {"solver": optx.BestSoFarLeastSquares(sd.GaussNewton(0.1))},
            TypeError,
            "the solver itself",
        ),
    ],
)
def test_what_cannot_work_says_what_to_write(levels, options, error, message):
    search = as_users_have_it(sd.coarse_to_fine)
    with pytest.raises(error, match=message):
        search(sd.least_squares, levels, jnp.ones(2), key=KEY, **options)
