"""Gauss-Newton on residuals: known optima, bounds, plateaus, faults, optimistix's solvers.

Compiling a step takes a hundred times as long as taking one, so the problems of the quick tests are
branches of one function: which of them is data, as are sigma, bounds and the key.
"""

import itertools
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import scipy.optimize
from closed_forms import largest

import smoothdiff as sd
from smoothdiff._params import take_apart
from smoothdiff._solvers._history import History
from smoothdiff._solvers._look import Look
from smoothdiff._solvers._wide_rounds import Wide
from tests.parts import quick_of

KEY = jax.random.key(3)
SIZE = 40  # residuals of each problem in the plane; the last of them may be zeros
DESIGN = np.random.default_rng(0).normal(size=(6, 2))
DATA = np.random.default_rng(1).normal(size=6)
TIMES = np.linspace(0, 1, 20)
PIXELS = np.arange(SIZE)
EVALUATED = []


def padded(rows):
    return jnp.pad(rows, (0, SIZE - len(rows)))


def line(y, given):
    """Linear, and not zero anywhere."""
    return padded(jnp.asarray(DESIGN, y.dtype) @ y - jnp.asarray(DATA, y.dtype))


def decay(y, noise):
    t = jnp.asarray(TIMES, y.dtype)
    return padded(y[0] * jnp.exp(-y[1] * t) - 2 * jnp.exp(-3 * t) - noise[:20])


def bar(y, half):
    return (jnp.abs(jnp.asarray(PIXELS, y.dtype) - y) <= half).astype(y.dtype)


def bars(y, target):
    """The square pictures of two bars, seven pixels wide; a plateau's middle is a whole number."""
    draw = lambda y: jnp.concatenate([bar(y[0], 3.5)[:20:2], bar(y[1], 3.5)[1:31]])
    return draw(y) - draw(target[:2])


def places(y, target):
    """A short and a long bar in one picture; where they have changed places, all ways lead up."""
    draw = lambda y: bar(y[0], 1.5) + bar(y[1], 4.5)
    return draw(y) - draw(target)


def table(y, given):
    return padded(jnp.stack([jnp.where(jnp.all(jnp.abs(y) < 50), 1.0, 0.0).astype(y.dtype)]))


def bowl(y, given):
    return padded(y - 1)


def waves(y, given):
    """A slope with waves."""
    return padded(100 - y + 5 * jnp.sin(y))


def wall(y, beyond):
    """A curve to a valley at 20, so that steps go too far, and anything beyond 20.5."""
    rows = padded(jnp.stack([20 - y[0] ** 2 / 20, y[1], jnp.ones_like(y[0])]))
    return jnp.where(y[0] > 20.5, beyond[0], rows)


def hole(y, given):
    rows = padded(jnp.stack([20 - y[0], y[1], jnp.ones_like(y[0])]))
    return jnp.where(jnp.abs(y[0] - 1) < 0.1, jnp.nan, rows)


def broken(y, edge):
    return jnp.where(y[0] > edge[0], jnp.nan, bowl(y, edge))


PLANE = [line, decay, bars, places, table, bowl, waves, wall, hole, broken]

# many parameters, of which most do nothing
N, MANY_SIZE = 1000, 80
MIX = np.random.default_rng(1).normal(size=(10, N)) / N**0.5
SHOW = np.random.default_rng(2).normal(size=(MANY_SIZE, 10))


def own(y, sought):
    """Each residual has two parameters of its own."""
    return y[:MANY_SIZE] + 0.3 * y[MANY_SIZE : 2 * MANY_SIZE] - sought


def mixed(y, given):
    """No residual has parameters of its own, but all depend on few combinations of them."""
    return jnp.asarray(SHOW, y.dtype) @ (jnp.asarray(MIX, y.dtype) @ y - 1)


def valley(y, given):
    """Narrow and bent."""
    y = y[: MANY_SIZE // 2 + 1]
    return jnp.concatenate([10 * (y[1:] - y[:-1] ** 2), 1 - y[:-1]])


def rounded(y, sought):
    return jnp.round(4 * (y[:MANY_SIZE] - sought))


def pit(y, sought):
    """The start is lower than all around it."""
    return own(y, sought) + jnp.where(jnp.any(y != 0), 3.0, 0.0).astype(y.dtype)


MANY = [own, mixed, valley, rounded, pit]


def seen(y):
    EVALUATED.append(np.array(y))


def one_of(problems, y, args):
    """The residuals of one of the problems; if they are watched, the point is in `EVALUATED`."""
    which, watched, given = args
    watch = lambda: jax.debug.callback(seen, y, ordered=True)
    jax.lax.cond(watched, watch, lambda: None)
    return jax.lax.switch(which, problems, y, given)


def plane(y, args):
    return one_of(PLANE, y, args)


def many(y, args):
    return one_of(MANY, y, args)


def problem(which, y0, given=(), dtype: Any = np.float32, watched=False) -> tuple[Any, ...]:
    """The function, the start and the arguments of one of the problems."""
    problems, fun, size = (PLANE, plane, SIZE) if which in PLANE else (MANY, many, MANY_SIZE)
    given = np.asarray(given, dtype)
    given = jnp.asarray(np.pad(given, (0, size - len(given))))
    args = jnp.asarray(problems.index(which), jnp.int32), jnp.asarray(watched), given
    return fun, jnp.asarray(np.asarray(y0, dtype)), args


def sides(bounds, dtype: Any = np.float32) -> Any:
    return bounds and tuple(jnp.asarray(np.asarray(side, dtype)) for side in bounds)


def solve(which, y0, given=(), sigma=0.3, bounds=None, dtype: Any = np.float32, **run):
    """The result on one of the problems, with a solver of these settings."""
    options = {"watched": run.pop("watched", False)}
    solver = {name: run.pop(name) for name in SOLVER if name in run}
    sigma = sigma if callable(sigma) else jnp.asarray(sigma, dtype)
    run = {"key": KEY, "bounds": sides(bounds, dtype)} | run
    if not run.keys() & {"max_steps", "max_evaluations"}:
        run["max_evaluations"] = 200
    EVALUATED.clear()
    fun, y0, args = problem(which, y0, given, dtype, **options)
    result = sd.least_squares(fun, y0, args, solver=sd.GaussNewton(sigma, **solver), **run)
    jax.effects_barrier()
    return result


SOLVER = ("num_samples", "nonfinite", "rtol", "atol", "patience", "restarts")
SEARCHES: dict[str, Any] = {"rtol": 1e-2, "atol": 1e-2, "patience": 6, "restarts": 6}
FEW: dict[str, Any] = {"num_samples": 48, "patience": 8, "restarts": 2, "bounds": (-4, 4)}
VALUE = jax.jit(lambda fun, y, args: fun(y, args), static_argnums=0)


def squares(which, y, given=(), **rest):
    """Half the sum of squares at one point, without noise."""
    fun, y, args = problem(which, y, given, **rest)
    return float(np.sum(np.square(VALUE(fun, y, args), dtype=np.float64))) / 2


# what it finds; in float64 within bounds that are far away, so that each dtype has one program


def far_bounds(dtype):
    return (-100, 100) if dtype == np.float64 else None


def test_a_linear_problem_is_solved_though_its_residuals_never_vanish(dtype):
    result = solve(line, (0, 0), sigma=1.0, dtype=dtype, bounds=far_bounds(dtype))
    best = np.linalg.lstsq(DESIGN, DATA)[0]
    assert result.y.dtype == dtype
    # the sum of squares is flat to the root of the rounding error
    np.testing.assert_allclose(result.y, best, atol=float(jnp.finfo(dtype).eps) ** 0.5)
    assert result.fun == pytest.approx(np.sum((DESIGN @ best - DATA) ** 2) / 2, rel=1e-3)


def test_a_curve_without_noise_is_fitted_to_rounding(dtype):
    result = solve(decay, (1, 1), dtype=dtype, bounds=far_bounds(dtype), max_evaluations=300)
    np.testing.assert_allclose(result.y, [2, 3], atol=2e3 * float(jnp.finfo(dtype).eps))


@pytest.mark.slow
def test_a_curve_with_noise_goes_to_the_least_squares_solution(x64):
    noise = 0.1 * np.random.default_rng(2).normal(size=20)
    curve = lambda y: y[0] * np.exp(-y[1] * TIMES) - 2 * np.exp(-3 * TIMES) - noise
    exact = scipy.optimize.least_squares(curve, np.ones(2), xtol=1e-12).x
    result = solve(decay, (1, 1), noise, dtype=np.float64, bounds=(-100, 100), max_evaluations=400)
    # 20 times closer than the truth is, which a standard error of the noise separates from it
    distance = np.linalg.norm(exact - np.array([2, 3]))
    assert np.linalg.norm(result.y - exact) < distance / 20


@pytest.mark.parametrize("bound", quick_of([(-0.1, 0.1), (-0.45, 5.0)], [(-0.45, 5.0)]))
def test_bounds_give_the_constrained_solution(bound, x64):
    result = solve(line, (0, 0), sigma=0.1, bounds=bound, dtype=np.float64, watched=True)
    best = scipy.optimize.lsq_linear(DESIGN, DATA, bound).x
    # or the test would show nothing
    assert np.any(np.isclose(best, bound[0]) | np.isclose(best, bound[1]))
    np.testing.assert_allclose(result.y, best, atol=1e-6)
    assert len(EVALUATED) == result.evaluations
    ys = np.stack([record.y for record in result.history])
    assert np.all((ys >= bound[0]) & (ys <= bound[1]))
    # a callback may run where float64 is off
    low, high = (np.float32(side) for side in bound)
    seen = np.stack(EVALUATED).astype(np.float32)
    assert np.all((seen >= low) & (seen <= high))


def test_steps_are_climbed_down_to_the_last(dtype):
    target = (14, 20)
    result = solve(bars, (8, 25), target, sigma=3.0, dtype=dtype, bounds=far_bounds(dtype))
    assert squares(bars, result.y, target, dtype=dtype) == 0


def test_one_plateau_everywhere_widens_sigma_until_it_is_left():
    """A wall of height one around the start, 50 away on all sides."""
    result = solve(table, (0, 0), sigma=1.0, max_evaluations=80)
    sigmas = [record.sigma for record in result.history]
    assert sigmas[:3] == [1.0] * 3
    assert max(sigmas) >= 32
    assert result.fun == 0


@pytest.mark.slow
def test_runs_of_optimistix_on_pytrees_inside_jit_are_those_on_vectors(x64):
    fun, y0, args = problem(line, (0.0, 0.0), dtype=np.float64)
    bounds, steps = (-0.45, 5.0), 6
    as_tree = lambda y: {"a": y[0], "b": [y[1:]]}
    solver = sd.GaussNewton(as_tree(np.array([0.2, 0.2])))

    @jax.jit
    def run(key, y0):
        options = {"key": key, "bounds": bounds}
        on_tree = lambda y, args: {"residuals": [fun(jnp.append(y["a"], y["b"][0]), args)]}
        solution = optx.least_squares(
            on_tree, solver, as_tree(y0), args, options, max_steps=steps, throw=False
        )
        return solution.value, solution.stats

    y, stats = run(KEY, y0)
    result = solve(line, y0, sigma=0.2, dtype=np.float64, bounds=bounds, max_steps=steps)
    assert jax.tree.structure(y) == jax.tree.structure(as_tree(y0))
    np.testing.assert_allclose(np.append(y["a"], y["b"][0]), result.y, rtol=1e-6)
    assert stats["evaluations"] == result.evaluations == steps + 1
    for name in ("fun", "smoothed", "stderr"):
        np.testing.assert_allclose(stats[name], getattr(result, name), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("precision", "steps", "restarts"),
    [("float32", 24, False), ("float64", 40, False), ("float64", 40, True)],
)
def test_iterates_are_those_of_optimistix_but_for_rounding(precision, steps, restarts):
    # searches amplify rounding, and where two ends are alike, it decides between them: so a start
    # may part, but from most of twelve both are the same
    with jax.enable_x64(precision == "float64"):
        solver = sd.GaussNewton(jnp.asarray(0.5, precision), **SEARCHES if restarts else {})
        options = {"key": KEY, "bounds": sides((-1, 5), precision)}
        noise = 0.1 * np.random.default_rng(4).normal(size=20)

        def same(y0):
            fun, y0, args = problem(decay, y0, noise, precision)
            given = (fun, solver, y0, args, options)
            solution = optx.least_squares(*given, max_steps=steps, throw=False)
            result = sd.least_squares(fun, y0, args, solver=solver, max_steps=steps, **options)
            # one a step, and the best point once more
            assert result.evaluations == len(result.history) + 1
            names = ("fun", "smoothed", "stderr", "evaluations")
            ours = [result.y, *(getattr(result, name) for name in names)]
            theirs = [solution.value, *(solution.stats[name] for name in names)]
            rtol = 1e-4 if precision == "float32" else 1e-8
            return all(map(partial(np.allclose, rtol=rtol, atol=0, equal_nan=True), ours, theirs))

        agree = [same(y0) for y0 in np.random.default_rng(0).uniform(-0.4, 4.4, (12, 2))]
        assert sum(agree) > len(agree) / 2, agree


def test_defaults_grow_with_the_parameters():
    few, many, very_many = (
        sd.GaussNewton(1.0).evaluations_per_step(jnp.zeros(n)) for n in (2, 100, 10**5)
    )
    assert (few, many, very_many) == (1, 50, 96)


@pytest.mark.parametrize("num_samples", [None, 4])
def test_what_is_reported_was_evaluated(num_samples):
    run = solve(bowl, (0, 0), num_samples=num_samples, watched=True, max_evaluations=33)
    assert len(EVALUATED) == run.evaluations
    took = np.diff([0, *(record.evaluations for record in run.history)])
    assert np.all(took == (num_samples or 1))
    for record in run.history:
        known = EVALUATED[: record.evaluations]
        assert any(np.array_equal(record.y, y) for y in known)
        assert record.fun == pytest.approx(min(squares(bowl, y) for y in known))


def test_a_linear_problem_takes_as_many_evaluations_as_its_model():
    """The start, one for each parameter, and the solution, which is judged once."""
    run = solve(bowl, (0.5, 0.7), sigma=0.6, max_steps=4)
    assert run.fun < 1e-10
    assert run.evaluations == 4 + 1


def test_bounds_turn_the_first_points_inwards():
    solve(bowl, (1, -2), sigma=1.0, bounds=(-2, 1), watched=True, max_steps=4)
    np.testing.assert_array_equal(EVALUATED[:3], [[1, -2], [0, -2], [1, -1]])


def test_a_step_that_fails_shrinks_the_radius_and_leaves_the_iterate():
    """On a slope with waves steps fail often; the iterate is the lowest so far all the same."""
    run = solve(waves, (0, 1), sigma=1.0, max_steps=60)
    found = [squares(waves, record.y) for record in run.history]
    local = [i for i in range(3, 60) if run.history[i].sigma < 1]
    assert local
    assert min(found) < 0.7 * found[0]


def test_the_residuals_of_a_jump_are_left_by_wide_rounds():
    """Jumps down to the valley: a local model sees one plateau after the other."""
    run = solve(bars, (3, 26), (14, 20), sigma=3.0, bounds=(0, 39), max_evaluations=300)
    assert squares(bars, run.y, (14, 20)) == 0


@pytest.mark.parametrize("beyond", [np.nan, np.inf, 1e22])
def test_the_end_of_a_step_may_be_anything(beyond):
    """The budget ends before float32 does: from the 18th evaluation on rounding decides."""
    result = solve(wall, (6, 1), [beyond], sigma=1.0, watched=True, max_evaluations=18)
    assert np.max(EVALUATED) > 20.5
    assert result.reason == "max_evaluations"
    np.testing.assert_allclose(result.y, [20, 0], atol=0.05)


def test_nan_during_a_step_keeps_what_was_found():
    with pytest.raises(sd.MinimiseError, match="NaN or infinite") as caught:
        solve(broken, (0, 0), [0.7], sigma=0.1, rtol=0.0)
    result = caught.value.result
    assert result.reason == "nonfinite"
    assert np.all(np.isfinite(result.y))
    assert result.history


# samples left out, with a schedule


def schedule(step):
    return 0.5 + 0.02 * step


DROPPING: dict[str, Any] = {"sigma": schedule, "nonfinite": "drop"}


def test_bad_samples_are_left_out():
    result = solve(broken, (0.5, 0.5), [1.6], watched=True, **DROPPING)
    np.testing.assert_allclose(result.y, 1, atol=1e-3)
    # or the test would show nothing
    assert np.sum(np.stack(EVALUATED)[:, 0] > 1.6) > 5


def test_an_iterate_that_is_dropped_is_no_perfect_one():
    result = solve(hole, (0, 0), max_evaluations=150, **DROPPING)
    # the longest step of all leads into the hole, and the best point of the history out of it
    assert result.history[0].y[0] == pytest.approx(1.0)
    assert result.history[1].y[0] > 1.5
    np.testing.assert_allclose(result.y, [20, 0], atol=0.05)


def test_a_schedule_is_taken_as_it_is():
    result = solve(line, (0, 0), max_steps=4, **DROPPING)
    widths = [record.sigma for record in result.history]
    assert widths == pytest.approx([schedule(step) for step in range(4)])


# several searches


def begun(sigma):
    """Which evaluations, from 0, were the first of a search: the next two are sigma away."""
    points = np.array(EVALUATED, float)
    away = np.stack([points[i + 1 : i + 3] - points[i] for i in range(len(points) - 2)])
    return np.flatnonzero(np.all(np.abs(np.abs(away) - sigma * np.eye(2)) < 1e-4, axis=(1, 2)))


@pytest.mark.slow
def test_a_restart_begins_elsewhere_within_the_bounds_with_the_first_sigma():
    bounds = (0, 39)
    run = solve(table, (8, 25), sigma=3.0, bounds=bounds, watched=True, max_steps=150, **SEARCHES)
    first = begun(3.0)
    assert first[0] == 0
    assert len(first) == 1 + SEARCHES["restarts"]
    # patience counts evaluations; the first search looks elsewhere before it ends
    looked = np.array([Look.length(2), *[0] * (SEARCHES["restarts"] - 1)])
    np.testing.assert_allclose(np.diff(first) - looked, SEARCHES["patience"], atol=1)
    places = np.array(EVALUATED)[first]
    assert len(np.unique(places, axis=0)) == len(places)
    assert np.all((places >= bounds[0]) & (places <= bounds[1]))
    # so does the last search
    assert run.reason == "stalled"


@pytest.mark.slow
def test_a_run_resumed_in_a_later_search_ends_with_the_same_bits(tmp_path):
    run = partial(solve, table, (8, 25), sigma=3.0, bounds=(0, 39), watched=True)
    run = partial(run, **SEARCHES | {"patience": 15})
    path, whole = tmp_path / "run.npz", run(max_steps=60)
    between = int(begun(3.0)[1]) + 2
    assert between < 60
    run(max_steps=between, checkpoint=path)
    resumed = run(max_steps=60, checkpoint=path)
    np.testing.assert_array_equal(resumed.y, whole.y)
    for name in ("step", "evaluations", "fun", "stderr", "sigma", "y"):
        one, other = ([getattr(r, name) for r in result.history] for result in (resumed, whole))
        np.testing.assert_array_equal(one, other)
    assert (resumed.fun, resumed.evaluations) == (whole.fun, whole.evaluations)


@pytest.mark.slow
def test_a_search_that_converged_is_followed_by_the_next():
    settings = SEARCHES | {"restarts": 2, "patience": 100}
    run = solve(decay, (1, 1), bounds=(-100, 100), max_steps=500, watched=True, **settings)
    assert run.reason == "converged"
    np.testing.assert_allclose(run.y, [2, 3], atol=0.02)
    assert len(begun(0.3)) == 1 + 2


@pytest.mark.slow
def test_restarts_find_the_deeper_of_two_valleys():
    # the bars begin where they have all but changed places
    y0, target = (28, 11), (10, 29)
    found = []
    at_target = lambda record: np.allclose(record.y, target, atol=1)
    for key in jax.random.split(KEY, 3):
        run = solve(
            places,
            y0,
            target,
            sigma=3.0,
            key=key,
            bounds=(0, 39),
            max_steps=800,
            callback=at_target,
            restarts=20,
            patience=30,
        )
        found.append(run.reason == "callback")
    assert all(found), found


@pytest.mark.slow
def test_restarts_find_the_deepest_of_several_valleys():
    y0, target = (28, 11), (10, 29)
    found = []
    for key in jax.random.split(KEY, 6):
        run = partial(solve, places, y0, target, sigma=3.0, key=key, bounds=(0, 39))
        one, all_of_them = run(max_steps=60), run(restarts=20, max_steps=1200)
        found.append([np.allclose(result.y, target, atol=1) for result in (one, all_of_them)])
        # nothing is different until the first search leads nowhere
        for a, b in zip(one.history[:30], all_of_them.history, strict=False):
            np.testing.assert_array_equal(a.y, b.y)
    by_one, by_all = np.sum(found, axis=0)
    assert by_one < 4
    assert by_all > 4


# many parameters


@pytest.mark.parametrize("num_samples", [None, 16])
def test_many_parameters_need_no_square_matrix_of_them(num_samples):
    n = 5_000
    fun = lambda y, args: jnp.stack([jnp.sum(y[::2]), jnp.sum(y[1::2])]) / n**0.5 - 1
    solver = sd.GaussNewton(0.1, num_samples=num_samples)
    run = partial(optx.least_squares, fun, solver, options={"key": KEY}, max_steps=3, throw=False)
    # four batches and a new one
    assert largest(lambda y0: run(y0).value, jnp.zeros(n)) <= 5 * 96 * n


@pytest.mark.slow
def test_few_samples_of_many_parameters_make_it_better():
    n = 5_000
    fun = lambda y, args: jnp.stack([jnp.sum(y[::2]), jnp.sum(y[1::2])]) / n**0.5 - 1
    solver = sd.GaussNewton(0.1, num_samples=16)
    result = sd.least_squares(fun, jnp.zeros(n), key=KEY, solver=solver, max_evaluations=300)
    assert result.fun < 0.5 * result.history[0].fun


@pytest.mark.slow
@pytest.mark.parametrize("parameters", [pytest.param(3, marks=pytest.mark.slow), 24])
def test_an_unknown_linear_map_is_learnt(parameters):
    """Fewer or more parameters than evaluations in the history, and a side that is closed."""
    matrix = np.random.default_rng(2).normal(size=(parameters, parameters)) / parameters**0.5
    sought = np.linspace(0.1, 0.9, parameters)
    result = sd.least_squares(
        lambda y, args: jnp.asarray(matrix, y.dtype) @ (y - jnp.asarray(sought, y.dtype)),
        jnp.full(parameters, 0.5),
        key=KEY,
        solver=sd.GaussNewton(0.5, num_samples=6, history=18),
        max_evaluations=60 * 3 if parameters == 3 else 6 * 100,
        bounds=(0.0, None),
    )
    start = np.sum((matrix @ (0.5 - sought)) ** 2) / 2
    assert result.fun < 0.02 * start


SOUGHT = np.random.default_rng(0).normal(size=MANY_SIZE)


@pytest.mark.slow
def test_which_residuals_a_parameter_moves_is_found():
    """Most of the thousand do nothing; a step sees 36 samples."""
    result = solve(own, np.zeros(N), SOUGHT, sigma=0.5, max_steps=12, **FEW)
    assert squares(own, result.y, SOUGHT) < 0.01 * squares(own, np.zeros(N), SOUGHT)


@pytest.mark.slow
def test_a_few_directions_of_many_parameters_are_enough():
    result = solve(mixed, np.zeros(N), sigma=1.0, max_steps=8, **FEW)
    assert squares(mixed, result.y) < 1e-3 * squares(mixed, np.zeros(N))


def test_steps_that_make_it_worse_are_not_taken():
    """There is noise in no direction: the sum of squares never rises."""
    result = solve(valley, np.full(N, -0.5), sigma=0.1, max_steps=12, watched=True, **FEW)
    # what is reported was evaluated: the steps that are tried, too
    assert len(EVALUATED) == result.evaluations == 12 * 48 + 2 + 48
    found = [squares(valley, record.y) for record in result.history]
    assert all(after <= before for before, after in itertools.pairwise(found))
    assert found[-1] < 0.5 * found[0]


def test_where_all_steps_make_it_worse_none_is_taken():
    result = solve(pit, np.zeros(N), SOUGHT, sigma=0.5, max_steps=4, **FEW)
    assert not np.any([record.y for record in result.history])
    assert squares(pit, result.y, SOUGHT) == squares(own, np.zeros(N), SOUGHT)


def test_many_parameters_restart():
    run = solve(rounded, np.zeros(N), SOUGHT, sigma=0.5, max_steps=40, **FEW)
    assert sum(not np.any(record.y) for record in run.history[:-1]) == 2
    assert run.fun < 0.1 * run.history[0].fun


@pytest.mark.slow
@pytest.mark.parametrize("bounds", [None, (-4.0, 4.0)])
def test_which_of_400_residuals_a_parameter_moves_is_found(bounds):
    """Each residual has two parameters of its own; 4,200 others do nothing."""
    n, size = 5_000, 400
    sought = jnp.asarray(np.random.default_rng(0).normal(size=size), jnp.float32)
    fun = lambda y, args: y[:size] + 0.3 * y[size : 2 * size] - sought
    run = partial(sd.least_squares, fun, jnp.zeros(n), key=KEY, solver=sd.GaussNewton(0.5))
    result = run(max_evaluations=6 * 96, bounds=bounds)
    assert float(jnp.sum(fun(result.y, None) ** 2)) < 0.01 * float(jnp.sum(sought**2))


@pytest.mark.slow
def test_a_few_directions_of_5000_parameters_are_enough():
    n, rank = 5_000, 10
    rng = np.random.default_rng(1)
    mix = jnp.asarray(rng.normal(size=(rank, n)) / n**0.5, jnp.float32)
    show = jnp.asarray(rng.normal(size=(60, rank)), jnp.float32)
    fun = lambda y, args: show @ (mix @ y - 1)
    run = partial(sd.least_squares, fun, jnp.zeros(n), key=KEY, solver=sd.GaussNewton(1.0))
    start = float(jnp.sum(fun(jnp.zeros(n), None) ** 2))
    assert float(jnp.sum(fun(run(max_evaluations=4 * 96).y, None) ** 2)) < 1e-3 * start


# what is refused, and other solvers


@pytest.mark.parametrize(
    "make",
    [
        lambda: sd.GaussNewton(0.1, num_samples=0),
        lambda: sd.GaussNewton(0.1, num_samples=8, history=4),
        lambda: sd.GaussNewton(0.1, restarts=-1),
        lambda: sd.GaussNewton(0.1, patience=0),
        lambda: solve(line, (0, 0), sigma=-1.0),
        lambda: sd.least_squares(
            lambda y, args: y["a"] * y["b"],
            {"a": jnp.ones(()), "b": jnp.ones(2)},
            key=KEY,
            solver=sd.GaussNewton({"a": 1.0, "b": None}),
        ),
    ],
    ids=["num_samples", "history", "restarts", "patience", "negative sigma", "no sigma"],
)
def test_bad_settings_are_refused(make):
    with pytest.raises(ValueError, match=r"num_samples|history|restarts|patience|sigma"):
        make()


def test_wrong_kinds_are_refused():
    integers = lambda y, args: jnp.round(y).astype(int)
    solver: Any = sd.GaussNewton(0.1)
    with pytest.raises(TypeError, match="astype"):
        sd.least_squares(integers, jnp.zeros(2), key=KEY, solver=solver)
    fun, y0, args = problem(line, (0, 0))
    with pytest.raises(TypeError, match="solver"):
        sd.minimise(fun, y0, args, key=KEY, solver=solver)
    solver = optx.LevenbergMarquardt(1e-3, 1e-3)
    with pytest.raises(TypeError, match="smoothdiff's"):
        sd.least_squares(fun, y0, args, key=KEY, solver=solver)


@pytest.mark.parametrize(
    "solver",
    [
        optx.LevenbergMarquardt(1e-4, 1e-4),
        pytest.param(optx.BFGS(1e-4, 1e-4), marks=pytest.mark.slow),
        pytest.param(optx.NonlinearCG(1e-4, 1e-4), marks=pytest.mark.slow),
    ],
    ids=lambda solver: type(solver).__name__,
)
def test_solvers_of_optimistix_run_on_a_smoothed_function(solver):
    target = jnp.array([14.0, 20.0])
    residuals = sd.smooth(lambda y: bars(y, target), 3.0, num_samples=64, baseline="mean")
    fixed = lambda y, args: residuals(KEY, y)

    @jax.jit
    def run(y0):
        solution = optx.least_squares(fixed, solver, y0, max_steps=40, throw=False)
        return solution.value, [jnp.sum(fixed(y, None) ** 2) for y in (y0, solution.value)]

    y, (before, after) = run(jnp.array([12.0, 21.5]))
    assert after < before
    np.testing.assert_allclose(y, target, atol=1.0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_wide_samples_stay_wide_along_a_parameter_that_tells_little(seed):
    pixels, n = jnp.linspace(-2.0, 2.0, 64), 3
    points = jax.random.normal(jax.random.key(seed), (16, n))
    # edges that jump along the first parameter, one pixel along the second, none along the third
    rows = (
        jnp.where(pixels[None] < points[:, :1], 1.0, 0.0) - jnp.where(pixels < 0.3, 1.0, 0.0)[None]
    )
    rows = rows.at[:, 0].set(0.1 * points[:, 1])
    history = History.of(points, rows, jnp.sum(rows**2, axis=1) / 2, jnp.ones(16, bool))
    params = take_apart(jnp.zeros(n), 1.0, None)
    wide = Wide.start(jnp.zeros(n), jnp.ones(64), jnp.ones(n))
    for _ in range(3):  # once it may grow by a half, and fall to a quarter
        wide = wide.stepped(history, params, jnp.asarray(16))
    first, _, third = wide.scale
    assert first < third / 2
    assert jnp.min(wide.scale) >= 0.1 * jnp.max(wide.scale)
