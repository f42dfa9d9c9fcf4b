"""Functions that draw random numbers: which ones they get, and what is found in spite of them."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest
from closed_forms import as_users_have_it

import smoothdiff as sd
from smoothdiff._solvers._averaging import Average, apart, seen_from_center
from smoothdiff._solvers._judgement import _clear_winner
from smoothdiff._solvers._stages import Sizes
from smoothdiff._solvers._wide_rounds import Wide, _noise_and_signal

KEY = jax.random.key(3)
TIMES = jnp.linspace(0, 4, 20)
RATE = jnp.array([0.8, 1.5])
START = np.array([0.3, 0.7], np.float32)
ADAM = sd.FirstOrder(optax.adam(0.05), 0.2)


def expected(y):
    """The mean over the rates, which are normal."""
    return y[1] * jnp.exp(-TIMES * y[0] + TIMES**2 * 0.09 / 2)


def decay(y, args, key):
    """Residuals by Monte Carlo, with 16 rates for each time."""
    rates = y[0] + 0.3 * jax.random.normal(key, (16, 20))
    return y[1] * jnp.mean(jnp.exp(-TIMES[None] * rates), axis=0) - args


DATA = expected(RATE)


def spread(y, args, key):
    """The mean square distance of 16 normal points, which is lowest at their mean."""
    points = args[None] + jnp.array([[1.0, 2.0]]) * jax.random.normal(key, (16, 2))
    return jnp.mean(jnp.sum((y[None] - points) ** 2, axis=1))


CENTER = jnp.array([0.3, -0.5])


# which numbers


class Host:
    """A function that remembers where it was called, and with which key."""

    def __init__(self):
        self.points, self.keys = [], []
        self.value = sd.black_box(self.one, jax.ShapeDtypeStruct((), jnp.float32))
        self.rows = sd.black_box(self.two, jax.ShapeDtypeStruct((2,), jnp.float32))

    def two(self, y, bits):
        self.points.append(np.array(y))
        self.keys.append(tuple(np.asarray(bits).tolist()))
        noise = np.random.default_rng(self.keys[-1]).normal(size=2)
        return np.float32(y - 1 + 0.1 * noise)

    def one(self, y, bits):
        return np.float32(np.sum(self.two(y, bits) ** 2))


HOST = Host()


def value(y, args, key):
    return HOST.value(y, jax.random.key_data(key))


def rows(y, args, key):
    return HOST.rows(y, jax.random.key_data(key))


@pytest.fixture
def host():
    """The one host of this file, so that it is compiled once; made new for each test."""
    HOST.points, HOST.keys = [], []
    return HOST


def test_a_batch_shares_its_numbers_and_the_next_one_has_others(host):
    sd.minimise(value, START, key=KEY, solver=ADAM, max_steps=4, takes_key=True)
    # five candidates in each of three rounds, and a last batch
    shares = [8] * 4 + [5] * 3 + [8]
    ends = np.cumsum(shares)
    assert len(host.keys) == ends[-1]
    groups = [set(host.keys[end - n : end]) for n, end in zip(shares, ends, strict=True)]
    assert [len(group) for group in groups] == [1] * 8
    assert len(set.union(*groups)) == 8
    # no other candidates in one round than in another
    judged = [np.stack(host.points[end - 5 : end]) for end in ends[4:7]]
    np.testing.assert_array_equal(judged[1], judged[0])
    np.testing.assert_array_equal(judged[2], judged[0])


@pytest.mark.parametrize(
    ("minimise", "fun", "solver"),
    [
        pytest.param(*each, marks=pytest.mark.slow)
        for each in (
            (sd.minimise, value, sd.ZeroGrads(0.2, num_samples=8)),
            (sd.minimise, value, sd.NewtonCG(lambda step: 0.2, num_samples=8)),
            (sd.least_squares, rows, sd.GaussNewton(lambda step: 0.2, num_samples=8)),
            (sd.least_squares, rows, sd.LocalGaussNewton(0.2, lambda y: y)),
        )
    ],
)
def test_so_it_is_with_every_solver_of_batches(minimise, fun, solver, host):
    result = minimise(fun, START, key=KEY, solver=solver, max_steps=4, takes_key=True)
    assert result.evaluations == len(host.keys)
    ends = [0, *(record.evaluations for record in result.history)]
    groups = [set(host.keys[a:b]) for a, b in itertools.pairwise(ends)]
    assert [len(group) for group in groups] == [1] * 4
    # three rounds of the judgement, and a last batch
    last = [key for key, _ in itertools.groupby(host.keys[ends[-1] :])]
    assert len(set(last)) == len(last) == 4
    assert len(set.union(*groups, last)) == 8


@pytest.mark.slow
@pytest.mark.parametrize("residuals", [False, True])
def test_the_local_model_shares_its_numbers_and_rounds_have_others(residuals, host):
    fun, minimise = (rows, sd.least_squares) if residuals else (value, sd.minimise)
    result = minimise(fun, START, key=KEY, sigma=0.3, max_evaluations=80, takes_key=True)
    assert result.reason == "max_evaluations"
    assert result.evaluations == len(host.keys) <= 80
    # three rounds of the mean and the lowest point, and of where the local model of a number ended
    last = 6 if residuals else 9
    assert len(host.keys) - len(result.history) == last
    keys = host.keys[: len(result.history)]
    local = keys.count(keys[0])
    assert set(keys[:local]) == {keys[0]}
    assert 4 < local < 50
    # each sample has its own, or a round of four
    shares = [keys[local:].count(key) for key in keys[local:-4]]
    assert set(shares) == {1 if residuals else 4}
    assert not set(host.keys[-last:]) & set(keys)
    assert len(set(host.keys[-last:])) == 3
    each = last // 3
    answers, places = host.points[-last : each - last], host.points[:local]
    np.testing.assert_array_equal(answers, host.points[-each:])
    if not residuals:
        # with the first key, which the first round has too
        values = [float(host.one(place, np.array(keys[0], np.uint32))) for place in places]
        ended = min(values[: local - 4])
        assert float(host.one(answers[1], np.array(keys[0], np.uint32))) == pytest.approx(ended)


@pytest.mark.slow
def test_a_key_with_ripples_of_its_own_is_left():
    keys = []

    @sd.black_box
    def rippled(y, bits):
        keys.append(int(bits))
        phase = np.random.default_rng(int(bits)).uniform(0, 6, 2)
        return np.float32(np.sum(y**2) + 0.05 * np.sum(np.sin(40 * y + phase)))

    fun = lambda y, args, key: rippled(y, jax.random.bits(key))
    sd.minimise(fun, START, key=KEY, sigma=0.3, max_evaluations=120, takes_key=True)
    # a turn of 12 (n + 1) evaluations after 2 n + 1 first points, and a first round; 60 without
    assert keys.count(keys[0]) <= 5 + 36 + 5


@pytest.mark.slow
def test_several_can_be_asked_for_at_once():
    search = sd.Search(START, key=KEY, residuals=True, sigma=0.3, takes_key=True)
    told = jax.jit(lambda y, key: decay(y, DATA, key))
    for _ in range(36):
        points = search.ask(4)
        search.tell(points, [told(jnp.asarray(point), search.key) for point in points])
    # all rounds that were paid for have gone on
    assert search._state.search.round() > 10
    assert len(search._came) < 8
    np.testing.assert_allclose(search.y, RATE, atol=0.1)


@pytest.mark.slow
def test_a_search_is_told_what_a_run_evaluates(host):
    run = sd.least_squares(rows, START, key=KEY, sigma=0.3, max_steps=100, takes_key=True)
    points, keys = host.points[:100], host.keys[:100]
    search = sd.Search(START, key=KEY, residuals=True, sigma=0.3, takes_key=True)
    for point, key in zip(points, keys, strict=True):
        bits = jax.random.key_data(search.key)
        assert tuple(np.asarray(bits).tolist()) == key
        (asked,) = search.ask()
        np.testing.assert_array_equal(asked, point)
        search.tell([asked], [host.two(asked, bits)])
    np.testing.assert_allclose(search.y, run.history[-1].y, rtol=1e-6)
    assert not search.done


@pytest.mark.slow
def test_a_run_that_is_taken_up_again_ends_with_the_same_bits(host, tmp_path):
    go = lambda steps, **loop: sd.minimise(
        value, START, key=KEY, solver=sd.NewtonCG(0.3), max_steps=steps, takes_key=True, **loop
    )
    whole = go(45)
    go(31, checkpoint=tmp_path / "run.npz")
    again = go(45, checkpoint=tmp_path / "run.npz")
    np.testing.assert_array_equal(again.y, whole.y)
    assert again.fun == whole.fun
    with pytest.raises(ValueError, match="another problem"):
        sd.minimise(
            lambda y, args: value(y, args, KEY),
            START,
            key=KEY,
            solver=sd.NewtonCG(0.3),
            checkpoint=tmp_path / "run.npz",
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("minimise", "twin", "fun", "solver", "args"),
    [
        (sd.minimise, optx.minimise, spread, ADAM, CENTER),
        pytest.param(
            *(sd.least_squares, optx.least_squares, decay, sd.GaussNewton(0.2), DATA),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_the_same_under_optimistix(minimise, twin, fun, solver, args):
    """But for rounding, which noise makes larger from step to step: so the first 15."""
    run = minimise(fun, START, args, key=KEY, solver=solver, max_steps=15, takes_key=True)
    options = {"key": KEY, "takes_key": True}
    pair = lambda y, args: fun(y, *args)
    found = twin(pair, solver, START, (args, KEY), options=options, max_steps=15, throw=False)
    np.testing.assert_allclose(run.y, found.value, rtol=1e-4)
    assert run.evaluations == found.stats["evaluations"]


# what is found


def median_gap(minimise, fun, gap, solver, args, budget, fresh, seeds):
    pair, found = lambda y, args: fun(y, *args), []
    for key in jax.random.split(KEY, seeds):
        call = {"fun": fun, "args": args} if fresh else {"fun": pair, "args": (args, key)}
        call |= {"y0": START, "key": key, "solver": solver, "takes_key": fresh}
        found.append(gap(minimise(max_evaluations=budget, **call).y))
    return np.median(found)


def decay_gap(y):
    return float(jnp.sum((expected(y) - DATA) ** 2))


def spread_gap(y):
    return float(jnp.sum((y - CENTER) ** 2))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("minimise", "fun", "gap", "solver", "args", "budget", "seeds"),
    [
        (sd.minimise, spread, spread_gap, ADAM, CENTER, 800, 3),
        pytest.param(
            *(sd.least_squares, decay, decay_gap, sd.GaussNewton(0.2), DATA, 200, 4),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            *(sd.minimise, spread, spread_gap, sd.NewtonCG(1.0), CENTER, 300, 4),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_fresh_numbers_find_more_than_fixed_ones(minimise, fun, gap, solver, args, budget, seeds):
    """At most as many evaluations; fixed numbers have a minimum of their own."""
    find = lambda fresh: median_gap(minimise, fun, gap, solver, args, budget, fresh, seeds)
    assert find(True) < 0.2 * find(False)


def light(y, args, key):
    """Residuals: light along a line, far less of it from farther away, with noise."""
    of = lambda y: 1 / (0.3 + (jnp.linspace(0, 1, 40) - y[0]) ** 2 + y[1] ** 2)
    return of(y) * (1 + 0.1 * jax.random.normal(key, (40,))) - of(args)


@pytest.mark.slow
def test_curved_residuals_do_not_move_the_answer():
    """By a regression over samples alone it was 0.006 nearer, as the mean over them is another."""
    lamp, bounds = jnp.array([0.3, 0.3]), (jnp.zeros(2), jnp.array([2.5, 1.5]))
    call = {"bounds": bounds, "takes_key": True, "max_evaluations": 400}
    find = lambda seed: sd.least_squares(
        light, jnp.array([1.5, 0.7]), lamp, key=jax.random.key(seed), **call
    )
    away = np.array([find(seed).y - lamp for seed in range(6)])
    assert np.all(np.abs(np.mean(away, axis=0)) < 0.003)


@pytest.mark.slow
def test_a_function_that_ignores_the_key_has_no_noise():
    flat = lambda y, args, key: jnp.sum((y - args) ** 2)
    result = sd.minimise(flat, START, CENTER, key=KEY, max_evaluations=60, takes_key=True)
    np.testing.assert_allclose(result.y, CENTER, atol=1e-2)


@pytest.mark.slow
def test_errors_of_the_parameters_come_from_evaluations_with_one_key():
    data = DATA + 0.05 * jax.random.normal(jax.random.key(1), DATA.shape)
    fun = lambda y, args, key: decay(y, args, key)
    run = sd.least_squares(
        fun, START, data, key=KEY, sigma=0.2, max_evaluations=100, takes_key=True
    )
    with pytest.warns(UserWarning, match=r"no error of.*args, key=key\), which have one"):
        assert np.all(np.isnan(run.parameter_errors))
    result = sd.with_covariance(fun, run, data, key=KEY)
    result = sd.with_covariance(fun, result, data, key=KEY)
    slopes = np.asarray(jax.jacobian(expected)(jnp.asarray(run.y)))
    # the errors are those of the data and of the function's own noise
    variance = 2 * run.fun / (len(data) - 2)
    errors = np.sqrt(variance * np.diag(np.linalg.inv(slopes.T @ slopes)))
    np.testing.assert_allclose(result.parameter_errors, errors, rtol=0.3)


# its parts


def test_another_candidate_wins_only_if_it_is_clearly_lower():
    points = jnp.arange(3.0)
    rounds = jnp.array([[5.0, 4.0, 4.9], [7.0, 8.0, 6.9], [3.0, 3.0, 2.9]])
    winner = lambda table: _clear_winner(table.ravel(), points)[:2]
    # the second is lower once, the third in every round by as much
    assert winner(rounds)[0] == 2
    y, fun = winner(rounds.at[0, 2].set(5.5))
    assert (y, fun) == (0, 5)
    # of equals the first, and never what is not finite
    assert winner(jnp.ones((3, 3)))[0] == 0
    assert winner(rounds.at[1, 2].set(jnp.nan))[0] == 0
    assert winner(rounds.at[1, 0].set(jnp.inf))[0] == 2


def test_the_mean_forgets_where_it_came_from():
    average = Average.start(jnp.array([100.0]))
    assert average.over(jnp.array([7.0])) == 7
    centers = [50.0] * 3 + [1.0] * 27
    for center in centers:
        average = average.after(jnp.array([center]))
    weight = np.cumprod([1.0] + [(k - 4) / (k + 3) for k in range(30, 4, -1)])
    assert weight[-1] < 1e-2
    assert average.over(jnp.array([7.0])) == pytest.approx(1, abs=0.05)


def test_samples_are_so_far_apart_that_they_differ_by_the_noise():
    random = np.random.default_rng(0)
    u, slopes = random.normal(size=(400, 3)), random.normal(size=(3, 6))
    noisy = u @ slopes + 2 * random.normal(size=(400, 6))
    half = np.arange(400) < 200
    many = np.where(half[:, None], noisy, 1e6).astype(np.float32)
    noise, signal = jax.jit(_noise_and_signal)(u.astype(np.float32), many, half)
    assert noise == pytest.approx(2 * np.sqrt(6), rel=0.1)
    assert signal == pytest.approx(np.linalg.norm(slopes), rel=0.1)
    width = lambda *a: float(jax.jit(apart)(*map(jnp.asarray, a)))
    assert width(0.1, 2.0, 1.6) == pytest.approx(0.125)
    assert width(0.1, 2.0, 0.0) == pytest.approx(0.15)
    assert width(0.1, 0.0, 2.0) == pytest.approx(0.025)
    assert width(0.9, 2.0, 1.0) == 1


def test_samples_say_how_residuals_change_and_the_center_what_they_are():
    random = np.random.default_rng(1)
    points, slopes = random.normal(size=(12, 2)), random.normal(size=(2, 5))
    there = np.arange(12) < 3
    points[there] *= 0.1
    rows = 1 + points @ slopes + np.where(there, 0, 7)[:, None]  # curved alike to all sides
    rows = rows + np.where(there, random.normal(size=12), 0)[:, None]
    valid = np.arange(12) != 11
    points, rows = points.astype(np.float32), rows.astype(np.float32)
    points, rows, valid, there = map(jnp.asarray, (points, rows, valid, there))
    u, seen, used = jax.jit(seen_from_center)(points, rows, valid, there)
    np.testing.assert_array_equal(used, valid & ~there)
    fit = np.linalg.lstsq(np.c_[np.ones(12), u][used], seen[used])[0]
    here = np.asarray(rows[there] - points[there] @ slopes).mean(axis=0)
    np.testing.assert_allclose(fit, np.r_[here[None], slopes], rtol=1e-4, atol=1e-5)
    # where none of them gave numbers, all is as it was
    same = seen_from_center(points, rows, valid, jnp.zeros(12, bool))
    for now, before in zip(same, (points, rows, valid), strict=True):
        np.testing.assert_allclose(now, before, rtol=1e-6)


def test_the_center_comes_every_second_time_after_the_first_rounds():
    wide = Wide.start(jnp.zeros(2), jnp.zeros(3), jnp.ones(2))
    later = eqx.tree_at(lambda w: (w.rounds, w.seen), wide, (jnp.asarray(7), jnp.asarray(True)))
    sizes, at_once = Sizes.of(None, 6, 4, 50), Sizes.of(4, 8, 4, 50)

    def round_of(wide, sizes, takes_key):
        near, samples, there = [], [], []
        for taken in range(0, int(wide.size(sizes, takes_key)), sizes.step):
            share, which = eqx.tree_at(lambda w: w.taken, wide, taken).places(sizes, takes_key)
            near += (share < 0.1).tolist()
            samples += which[share == 1].tolist()
            there += which[(share > 0) & (share < 1)].tolist()
        assert len(set(there)) == len(there)  # no two at one point
        return near, samples

    first = [True] + [False] * 5, list(range(5))
    assert round_of(wide, sizes, True) == round_of(wide, sizes, False) == first
    assert round_of(later, sizes, False) == ([True] + [False] * 3, list(range(3)))
    assert round_of(later, sizes, True) == ([True, False] * 4, list(range(4)))
    # evaluations at once have the same numbers
    assert round_of(later, at_once, True) == ([True] + [False] * 3, list(range(3)))


# what is told


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: sd.minimise(spread, START, CENTER, key=KEY), "takes_key=True if it takes a key"),
        (
            lambda: sd.minimise(lambda y, args: 0.0, START, key=KEY, takes_key=True),
            r"called as fun\(y, args, key\)",
        ),
    ],
)
def test_a_function_of_other_arguments_is_told_what_to_write(call, match):
    with pytest.raises(TypeError, match=match):
        call()


def test_what_does_not_go_with_noise_is_refused():
    minimise = as_users_have_it(sd.minimise)
    solver = sd.NewtonCG(0.3, restarts=2)
    with pytest.raises(ValueError, match="several starts"):
        minimise(spread, START, CENTER, key=KEY, solver=solver, takes_key=True)
    search = sd.Search(START, key=KEY)
    with pytest.raises(ValueError, match="write takes_key=True"):
        _ = search.key
    run = sd.least_squares(decay, START, DATA, key=KEY, sigma=0.2, max_steps=4, takes_key=True)
    with pytest.raises(ValueError, match="takes a key: write key="):
        sd.with_covariance(decay, run, DATA)
    pair = {"key": KEY, "takes_key": True}
    with pytest.raises(ValueError, match=r"args=\(args, key\)"):
        optx.minimise(lambda y, args: jnp.sum(y), ADAM, START, CENTER, options=pair)


def test_a_recommendation_sees_the_noise():
    said = sd.recommend(decay, START, DATA, key=KEY, takes_key=True)
    assert said.seen[0].startswith("noise: the same point twice differs by")
    assert said.evaluations == 2 * len(START) + 4
