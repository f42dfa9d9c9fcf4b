"""What a run returns: without noise the lowest of all that was evaluated, with noise a fair winner.

The problems are branches of one black box, so that each solver is compiled once for all of them.
"""

import contextlib
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import smoothdiff as sd
from smoothdiff._seen import Seen
from smoothdiff._solvers._base import Progress
from smoothdiff._solvers._judgement import Values, judged, judging
from tests.parts import quick_of

KEY = jax.random.key(2)
TARGET = np.array([0.6, -0.4], np.float32)
START = np.zeros(2, np.float32)
LIKE = jnp.asarray(START)
LOW, HIGH = np.array([-1.0, -1.0], np.float32), np.array([0.55, 2.0], np.float32)


# residuals, one for each parameter; a loss is half the sum of their squares


def stair(y):
    return np.floor(4 * np.abs(y - TARGET)) + 1


def jump(y):
    return y - TARGET + 3 * (y[0] < 0.2)


def tail(y):
    """The loss is up to 1e30."""
    return (y - TARGET) * 10 ** np.minimum(20 * np.abs(y - TARGET), 15)


def hole(y):
    return np.where(y[1] > 0.2, np.nan, y - TARGET)


def bowl(y):
    return y - TARGET


class Host:
    """A black box that remembers all points and values, without noise or with."""

    def __init__(self):
        self.new(bowl)
        one, two = (jax.ShapeDtypeStruct(shape, jnp.float32) for shape in [(), (2,)])
        box = functools.partial(sd.black_box, on_nonfinite="nan")
        self._loss, self._rows = box(self._one, one), box(self._two, two)

    def new(self, problem, noise=0.0):
        self.problem, self.noise, self.points, self.values = problem, noise, [], []
        self.random = np.random.default_rng(0)

    def _two(self, y):
        rows = np.float32(self.problem(y) + self.noise * self.random.normal(size=2))
        self.points.append(np.array(y))
        self.values.append(np.sum(rows**2) / 2)
        return rows

    def _one(self, y):
        self._two(y)
        return self.values[-1]

    def loss(self, y, args):
        return self._loss(y)

    def rows(self, y, args):
        return self._rows(y)

    def truth(self, y):
        return np.sum(np.float32(self.problem(np.asarray(y))) ** 2) / 2


HOST = Host()
LOSS, ROWS = HOST.loss, HOST.rows  # the same objects each time, so that they are compiled once
SETTINGS = {
    "first order": lambda: sd.FirstOrder(optax.adam(0.1), 0.3, nonfinite="drop"),
    "chunks": lambda: sd.FirstOrder(optax.adam(0.1), 0.3, batch_size=3, nonfinite="drop"),
    "newton": lambda: sd.NewtonCG(0.3, nonfinite="drop"),
    "restarts": lambda: sd.NewtonCG(0.3, nonfinite="drop", patience=2, restarts=3),
    "zerograds": lambda: sd.ZeroGrads(0.3, num_samples=8, nonfinite="drop"),
    "gauss-newton": lambda: sd.GaussNewton(0.3, nonfinite="drop"),
    "local": lambda: sd.LocalGaussNewton(0.3, lambda y: y, nonfinite="drop"),
}


class Run:
    """One of the solvers on the problem of the black box."""

    def __init__(self, solver):
        self.solver = solver
        self.of_residuals = isinstance(solver, sd.GaussNewton | sd.LocalGaussNewton)

    def __call__(self, problem, y0=START, noise=0.0, **limits):
        HOST.new(problem, noise)
        limits = {"bounds": (LOW, HIGH), "key": KEY} | (limits or {"max_steps": 5})
        minimise = sd.least_squares if self.of_residuals else sd.minimise
        fun = ROWS if self.of_residuals else LOSS
        try:
            return minimise(fun, y0, solver=self.solver, **limits)
        except sd.MinimiseError as error:
            return error.result


@pytest.fixture(scope="module", params=quick_of(SETTINGS, ["chunks", "newton", "gauss-newton"]))
def run(request):
    return Run(SETTINGS[request.param]())


def assert_lowest(result):
    """It is the lowest of all that the black box was called with, which is what is reported."""
    assert result.evaluations == len(HOST.points)
    assert np.nanmin(HOST.values) == HOST.truth(result.y) == pytest.approx(result.fun, rel=1e-6)
    # to the last bit, so that what is returned is nothing that nobody looked at
    assert any(np.array_equal(result.y, y) for y in HOST.points)
    points = np.stack(HOST.points)
    assert np.all((points >= LOW) & (points <= HIGH))


@pytest.mark.parametrize("problem", [stair, jump, tail, hole], ids=lambda f: f.__name__)
def test_without_noise_it_is_the_lowest_of_all_that_was_evaluated(problem, run):
    result = run(problem)
    assert_lowest(result)
    assert result.fun < HOST.truth(START)
    if problem is hole:
        # or the test would show nothing
        assert np.isnan(HOST.values).any()
    if problem is tail:
        assert np.max(HOST.values) > 1e12


def test_a_start_that_is_the_optimum_is_returned(run):
    best = np.minimum(TARGET, HIGH)
    result = run(bowl, best)
    assert_lowest(result)
    np.testing.assert_array_equal(result.y, best)


def test_with_noise_it_is_no_worse_than_the_start_but_for_the_noise(run):
    noise = 0.1
    best = np.minimum(TARGET, HIGH)
    result = run(bowl, best, noise)
    # the loss at the start varies by 0.05 noise + noise^2, and the mean of three by less
    assert HOST.truth(result.y) < HOST.truth(best) + 4 * (0.05 * noise + noise**2)
    # the lowest value is luck, and not what is reported
    assert np.min(HOST.values) < result.fun
    before = result.history[-1].evaluations
    fresh = [
        value
        for point, value in zip(HOST.points[before:], HOST.values[before:], strict=True)
        if np.array_equal(point, result.y)
    ]
    assert len(fresh) >= 3
    assert np.min(fresh) < result.fun < np.max(fresh)
    assert result.evaluations == len(HOST.points) == before + run.solver.final_evaluations(LIKE)


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_the_budget_is_not_exceeded(noise, run):
    step, last = run.solver.evaluations_per_step(LIKE), run.solver.final_evaluations(LIKE)
    budget = 3 * step + last
    result = run(bowl, START, noise, max_evaluations=budget)
    assert result.reason == "max_evaluations"
    assert len(result.history) >= 3
    assert result.evaluations == len(HOST.points) <= budget


POINT_BY_POINT = ["newton", "restarts", "gauss-newton"]


@pytest.mark.parametrize("solver", quick_of(POINT_BY_POINT, ["newton", "gauss-newton"]))
@pytest.mark.parametrize("more", quick_of([0, 1, 4, 17], [0, 4]))
def test_without_noise_steps_take_what_the_judgement_does_not_need(solver, more):
    run = Run(SETTINGS[solver]())
    budget = 1 + run.solver.final_evaluations(LIKE) + more
    result = run(tail, max_evaluations=budget)
    assert result.reason == "max_evaluations"
    assert_lowest(result)
    assert result.evaluations == budget
    # the lowest point again, twice, and the only candidate
    assert result.history[-1].evaluations == budget - (2 if run.of_residuals else 3)
    # the steps are those of a run with a larger budget
    longer = run(tail, max_evaluations=budget + 9)
    for record, same in zip(result.history, longer.history, strict=False):
        np.testing.assert_array_equal(record.y, same.y)


@pytest.mark.parametrize("solver", quick_of(POINT_BY_POINT, ["newton", "gauss-newton"]))
def test_with_noise_the_judgement_takes_what_was_set_aside(solver):
    run = Run(SETTINGS[solver]())
    last = run.solver.final_evaluations(LIKE)
    result = run(bowl, START, 0.1, max_evaluations=20 + last)
    assert result.evaluations == len(HOST.points) == 20 + last
    assert result.history[-1].evaluations == 20
    fresh = zip(HOST.points[20:], HOST.values[20:], strict=True)
    values = [value for point, value in fresh if np.array_equal(point, result.y)]
    assert result.fun == pytest.approx(np.mean(values[:3]), rel=1e-5)


def test_noise_that_is_seen_late_is_in_what_is_reported():
    """It begins after the trial that shows none; the run would have converged before."""
    solver = sd.GaussNewton(0.3, rtol=0, atol=0, nonfinite="drop")
    budget = 20 + solver.final_evaluations(LIKE)

    def stop(record):
        HOST.noise = 0.1 if record.evaluations > 20 else 0.0

    result = Run(solver)(bowl, START, max_evaluations=budget, callback=stop)
    assert result.evaluations == len(HOST.points) == budget
    assert result.fun == pytest.approx(HOST.values[-1], rel=1e-6)


@pytest.mark.slow
def test_samples_of_a_step_that_does_not_fit_cost_no_trial():
    solver = sd.GaussNewton(0.3, num_samples=8)
    result = Run(solver)(tail, max_evaluations=32 + solver.final_evaluations(LIKE))
    assert result.evaluations == len(HOST.points) == 32 + 1


@pytest.mark.slow
def test_an_interruption_after_the_trial_changes_nothing(tmp_path):
    run = Run(SETTINGS["newton"]())
    budget = 20 + run.solver.final_evaluations(LIKE)
    whole = run(tail, max_evaluations=budget)

    def stop(record):
        if record.evaluations == 23:
            raise KeyboardInterrupt

    path = tmp_path / "run"
    assert run(tail, max_evaluations=budget, callback=stop, checkpoint=path).reason == "interrupted"
    again = run(tail, max_evaluations=budget, checkpoint=path)
    assert (again.evaluations, again.fun, len(again.history)) == (
        whole.evaluations,
        whole.fun,
        len(whole.history),
    )


def test_without_noise_little_is_spent_on_the_judgement(run):
    """The lowest again, each candidate that was not evaluated yet, and a batch."""
    result = run(bowl)
    took = result.evaluations - result.history[-1].evaluations
    step = run.solver.evaluations_per_step(LIKE)
    candidates = 1 if run.of_residuals else 4
    assert took <= 1 + candidates + step


def test_a_run_that_was_interrupted_returns_the_lowest(run):
    def stop(record):
        if record.step == 3:
            raise KeyboardInterrupt

    result = run(stair, max_steps=5, callback=stop)
    assert result.reason == "interrupted"
    assert_lowest(result)
    assert np.isnan([result.smoothed, result.stderr]).all()


# the judgement alone


def judge(fun, seen, new, old=()):
    """Of a run that saw this point with this value."""
    first = jnp.asarray(new[0])
    progress = Progress.start(first, jnp.float32)
    finite = jnp.asarray(True)
    estimate = first, jnp.float32(0), jnp.float32(0), 1.0
    progress = progress.after(*estimate, 10, finite, Seen(jnp.asarray(seen[0]), seen[1]))
    batch = lambda y: (fun(y), jnp.float32(0), Seen(y, fun(y)))
    values = Values(lambda points, number: jax.vmap(fun)(points), takes_key=False)
    return judged(progress, values, batch, 4, new, old)


def test_candidates_that_are_not_finite_lose_and_the_first_of_equals_wins():
    points = [[4, 1, 5], [1, -1, -1], [-1, -1, -1], [9, -9, 9]]

    @jax.jit
    @jax.vmap
    def best(p):
        fun = lambda y: jnp.sqrt(y) // 1
        return judge(fun, (jnp.float32(9.5), jnp.float32(3)), [p[0], p[1]], [p[2]])

    y, stats = best(np.array(points, np.float32))
    np.testing.assert_array_equal(y, [1, 1, 9.5, 9])
    np.testing.assert_array_equal(stats["fun"], [1, 1, 3, 3])
    np.testing.assert_array_equal(stats["evaluations"], 10 + 3 + 4)


def test_what_rounding_does_is_no_noise_and_what_luck_did_is():
    fun = lambda y: (y - 2) ** 2 + 1

    @jax.jit
    @jax.vmap
    def best(value):
        return judge(fun, (jnp.float32(1), value), [jnp.float32(0)], [jnp.float32(3)])

    close = np.float32(2) + np.spacing(np.float32(2)) * np.arange(-2, 3, dtype=np.float32)
    y, stats = best(np.append(close, np.float32(0.5)))
    assert stats["evaluations"].tolist() == [10 + 2 + 4] * 5 + [10 + judging(4, 1, 1)]
    assert judging(4, 1, 1) == 3 * 3 + 1 + 4
    # the other candidate was seen before, so that nothing was to be expected of it without noise
    np.testing.assert_array_equal(y, 1)
    np.testing.assert_array_equal(stats["fun"], 2)


@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan, 3e38])
def test_values_that_are_infinite_are_no_reason_to_warn(value):
    fun = lambda y, args: jnp.where(y[0] > 0, jnp.float32(value), -jnp.float32(value))
    solver = sd.NewtonCG(0.3, nonfinite="drop")
    with contextlib.suppress(sd.MinimiseError):
        sd.minimise(fun, jnp.ones(2), key=KEY, solver=solver, max_steps=0)
    with contextlib.suppress(sd.MinimiseError):
        sd.minimise(fun, jnp.ones(2), key=KEY, solver=solver, max_evaluations=12)


def test_float64_residuals_of_float32_parameters_are_no_noise(x64):
    fun = lambda y, args: jnp.cos(y.astype(jnp.float64)) * jnp.array([1.1, 0.3]) + 0.7
    solver = sd.GaussNewton(0.3)
    result = sd.least_squares(fun, START, key=KEY, solver=solver, max_steps=3)
    assert result.y.dtype == jnp.float32
    assert result.evaluations == result.history[-1].evaluations + 1
    assert result.fun == pytest.approx(float(jnp.sum(fun(result.y, None) ** 2)) / 2, rel=1e-6)


@pytest.mark.slow
def test_a_search_that_ends_far_away_on_a_plateau_is_judged():
    # so far away that sigma is less than the spacing of numbers there
    solver = sd.GaussNewton(0.06, restarts=1)
    flat = lambda y, args: jnp.full(1, 7.0) + 0 * y
    found = sd.least_squares(flat, jnp.array([40.0]), key=KEY, solver=solver)
    assert found.fun == 24.5


@pytest.mark.parametrize("solver", quick_of(["newton", "gauss-newton"], ["newton"]))
def test_a_function_that_fails_at_the_end_costs_nothing_that_was_found(solver):
    run = Run(SETTINGS[solver]())
    # the call after the last step's is the first of the judgement
    steps = run(bowl, max_evaluations=900).history[-1].evaluations

    def failing(y):
        works = len(HOST.points) < steps or np.array_equal(y, START)
        return bowl(y) * (1 if works else np.nan)

    result = run(failing, max_evaluations=900)
    assert steps < len(HOST.points) < 900
    lowest = np.nanmin(HOST.values)
    assert result.fun == pytest.approx(lowest, rel=1e-6)
    known = zip(HOST.points, HOST.values, strict=True)
    assert any(value == lowest and np.array_equal(result.y, y) for y, value in known)
    assert not np.array_equal(result.y, START)


@pytest.mark.parametrize("solver", quick_of(SETTINGS, ["newton"]))
def test_where_nothing_is_lower_the_start_is_the_answer(solver):
    result = Run(SETTINGS[solver]())(lambda y: np.ones(2), max_evaluations=150)
    np.testing.assert_array_equal(result.y, START)
    assert result.reason != "noise"
