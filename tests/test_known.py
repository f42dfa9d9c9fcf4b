"""Whole numbers: no point is evaluated again for nothing, and a run ends where all are known."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import smoothdiff as sd
from smoothdiff._known import Known
from smoothdiff._layout import layout_of
from smoothdiff._unit_space import UnitSpace
from tests.parts import quick_of

KEY = jax.random.key(0)
BEST = np.array([3, 17, 9])
GRID = sd.Integer(0, 20)
START = {"a": 10, "b": jnp.array([10, 10])}
# evaluated again: two to see that there is no noise, one to see what a black box returns, and at
# most so many to judge
AGAIN = 3 + 3


class Counted:
    """A black box of whole numbers that keeps its points."""

    value: Any

    def __init__(self, value: Any):
        self.value, self.points = value, []

    def __call__(self, y, args):
        y = np.hstack(jax.tree.leaves(y)).astype(float)
        self.points.append(tuple(y.tolist()))
        return self.value(y)

    @property
    def distinct(self):
        return len(set(self.points))


def bowl(y):
    return np.sum((y - BEST) ** 2)


def offsets(y):
    return y - BEST + np.sin(y)


@pytest.mark.slow
@pytest.mark.parametrize("call", [sd.minimise, sd.least_squares])
@pytest.mark.parametrize("y0", [1, 2])
def test_a_range_is_known_after_each_of_its_numbers(call, y0):
    fun = Counted(lambda y: 0.5 + (y[0] - 4) ** 2)
    result = call(sd.black_box(fun), y0, key=KEY, space=sd.Integer(1, 5))
    assert (int(result.y), result.reason) == (4, "converged")
    assert result.evaluations == len(fun.points) <= 5 + AGAIN
    assert fun.distinct == 5


@pytest.mark.parametrize(
    ("call", "value", "at_once"),
    [
        pytest.param(sd.minimise, bowl, 1, marks=pytest.mark.slow),
        (sd.least_squares, offsets, 1),
        pytest.param(sd.least_squares, offsets, 4, marks=pytest.mark.slow),
    ],
)
def test_each_point_of_a_grid_is_evaluated_once(call, value, at_once):
    solver = sd.NewtonCG if call is sd.minimise else sd.GaussNewton
    fun = Counted(value)
    solver = solver(0.2, num_samples=at_once)
    result = call(sd.black_box(fun), START, key=KEY, space=GRID, solver=solver)
    assert result.evaluations == len(fun.points) <= fun.distinct + AGAIN + at_once
    funs = [
        np.sum(value(np.array(y)) ** 2) / 2 if value is offsets else bowl(y) for y in fun.points
    ]
    assert result.fun == pytest.approx(min(funs), rel=1e-6)
    # a run that forgets evaluates most points again
    assert result.history[-1].step > 1.5 * len(fun.points) / at_once


@pytest.mark.slow
def test_a_function_of_jax_is_known_as_well():
    y0, space = START | {"a": 2}, {"a": sd.Integer(1, 4), "b": sd.Integer(9, 10)}
    fun = lambda y, args: (y["a"] - 3) ** 2 + jnp.sum(y["b"]) - 18
    result = sd.minimise(fun, y0, key=KEY, space=space)
    assert result.fun == 0
    assert result.evaluations <= 16 + AGAIN


@pytest.mark.slow
def test_numbers_that_are_not_all_whole_are_not_known():
    fun = Counted(lambda y: np.sum(y**2))
    space = {"a": sd.Integer(-20, 20), "b": sd.Range(-20, 20)}
    result = sd.minimise(sd.black_box(fun), START, key=KEY, space=space)
    assert int(result.y["a"]) == 0
    assert result.evaluations == len(fun.points)


def test_noise_is_averaged_over_repeats():
    numbers = np.random.default_rng(0)
    fun = Counted(lambda y: (y[0] - 4) ** 2 + 0.1 * numbers.standard_normal())
    result = sd.minimise(sd.black_box(fun), 2, key=KEY, space=sd.Integer(1, 5))
    assert int(result.y) == 4
    assert result.evaluations == len(fun.points) > 3 * fun.distinct


def test_noise_that_shows_late_is_seen():
    quiet = Counted(lambda y: (y[0] - 4) ** 2)
    result = sd.minimise(sd.black_box(quiet), 50, key=KEY, space=sd.Integer(0, 99))
    few = result.evaluations
    noisy = Counted(None)
    numbers = np.random.default_rng(0)
    noisy.value = lambda y: (y[0] - 4) ** 2 + (len(noisy.points) == 2) * numbers.uniform(1, 2)
    result = sd.minimise(sd.black_box(noisy), 50, key=KEY, space=sd.Integer(0, 99))
    assert (int(result.y), result.fun) == (4, 0)
    assert result.evaluations == len(noisy.points) < 20 * few


def test_luck_that_is_known_is_seen_in_the_end():
    """It is quiet where the run begins: two points have the same value again."""
    numbers = np.random.default_rng(3)
    noise = lambda y: abs(y - 9) / 5 + 0.3 * numbers.standard_normal()
    fun = Counted(lambda y: 1.0 if y[0] < 6 else noise(y[0]))
    result = sd.minimise(sd.black_box(fun), 3, key=KEY, space=sd.Integer(0, 12))
    assert result.evaluations == len(fun.points) >= 2 * fun.distinct
    assert result.fun > -0.3


def test_a_failed_evaluation_is_tried_again():
    fun = Counted(None)
    fun.value = lambda y: np.nan if fun.points.count((4,)) == 1 and y[0] == 4 else (y[0] - 4) ** 2
    box = sd.black_box(fun, on_nonfinite="nan")
    result = sd.minimise(box, 2, key=KEY, space=sd.Integer(1, 5))
    assert (int(result.y), result.fun) == (4, 0)


@pytest.mark.slow
def test_a_run_goes_on_from_a_checkpoint(tmp_path):
    class StoppedError(Exception):
        pass

    def stop(record):
        if record.step == 12:
            raise StoppedError

    box, path = sd.black_box(Counted(bowl)), tmp_path / "run"
    with pytest.raises(StoppedError):
        sd.minimise(box, START, key=KEY, space=GRID, checkpoint=path, callback=stop)
    result = sd.minimise(box, START, key=KEY, space=GRID, checkpoint=path)
    assert (int(result.y["a"]), result.y["b"].tolist()) == (3, [17, 9])


@pytest.mark.slow
def test_a_run_that_has_ended_takes_no_step_when_it_is_called_again(tmp_path):
    fun = Counted(lambda y: (y[0] - 4) ** 2)
    call = lambda: sd.minimise(
        sd.black_box(fun), 2, key=KEY, space=sd.Integer(1, 5), checkpoint=tmp_path / "run"
    )
    first, count = call(), len(fun.points)
    again = call()
    assert (again.reason, len(again.history)) == (first.reason, len(first.history))
    # one to see what it returns, one whether it is the same function, and the judgement
    assert len(fun.points) <= count + 2 + 3


@pytest.mark.parametrize("target", [None, pytest.param(-1.0, marks=pytest.mark.slow)])
def test_what_fails_always_is_tried_twice(target):
    fun = Counted(lambda y: np.nan if y[0] == 30 else abs(y[0] - 7))
    box = sd.black_box(fun, on_nonfinite="nan")
    result = sd.minimise(box, 2, key=KEY, space=sd.Integer(0, 30), target=target)
    assert (int(result.y), result.fun) == (7, 0)
    assert fun.points.count((30,)) <= 2
    assert result.evaluations == len(fun.points) <= 31 + AGAIN + 4


def test_numbers_of_different_types_have_names_of_their_own():
    with jax.enable_x64(True):
        y = {"a": np.uint64(1), "b": np.int64(2)}
        units = UnitSpace.of(y, {"a": sd.Integer(0, 2**50), "b": sd.Integer(0, 9)})
        unit = units.unit(y)
        known, layout = Known.of(units, unit, None), layout_of(unit)
        assert known is not None
        near = [units.unit({"a": np.uint64(a), "b": np.int64(2)}) for a in (2**49, 2**49 + 4)]
        points = jnp.stack([layout.vector(jax.tree.leaves(u)) for u in near])
        known.learn(points, jnp.array([[1.0], [2.0]]))
        known.learn(points, jnp.array([[1.0], [2.0]]))
        unused = lambda points: pytest.fail("evaluated again")
        np.testing.assert_array_equal(known.rows(points, unused), [[1.0], [2.0]])


@pytest.mark.parametrize("limit", quick_of([20, 25], [20]))
def test_a_limit_holds_where_points_are_known(limit):
    fun = Counted(bowl)
    result = sd.minimise(sd.black_box(fun), START, key=KEY, space=GRID, max_evaluations=limit)
    assert result.evaluations == len(fun.points) <= limit
