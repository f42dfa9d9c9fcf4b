"""What a search may be told: nothing of a call that is wrong is taken in, and all else counts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import smoothdiff as sd

KEY = jax.random.key(0)


def bowl(y):
    return float((y[0] - 1) ** 2 + 10 * (y[1] + 2) ** 2)


def test_so_many_points_are_asked_for_or_none():
    search = sd.Search(jnp.zeros(2), key=KEY)
    assert search.ask(0) == []
    assert len(search.ask(np.int64(2))) == 2
    with pytest.raises(ValueError, match="0 or more, not -1"):
        search.ask(-1)
    with pytest.raises(TypeError, match="whole number"):
        search.ask(2.0)  # type: ignore[arg-type]


def test_the_best_of_those_told_is_known_at_once():
    """Also while the point that the solver waits for is missing."""
    search = sd.Search(jnp.zeros(2), key=KEY)
    points = search.ask(5)
    search.tell(points[1:3], [np.nan, np.nan])
    assert search.fun == np.inf
    np.testing.assert_array_equal(search.y, [0, 0])
    search.tell(points[3:], [bowl(y) for y in points[3:]])
    assert search.evaluations == 4
    assert search.fun == min(bowl(y) for y in points[3:])
    np.testing.assert_array_equal(search.y, min(points[3:], key=bowl))


@pytest.mark.parametrize(
    ("y0", "settings", "point", "match"),
    [
        (0.5, {"space": sd.Range(0, 1)}, 3.0, r"outside its range \[0.0, 1.0\]: choose it within"),
        (0.5, {"space": sd.Positive()}, -3.0, "-3.0 is not positive"),
        (3, {"space": sd.Integer(0, 5)}, 2.5, "2.5 is not a whole number"),
        ([0.5, 0.5], {"bounds": (0, 1)}, [3.0, 0.5], "lies outside its bounds"),
        ([0.5, 0.5], {}, [np.nan, 1.0], "a point is not finite"),
        ([0.5, 0.5], {}, [0.5], "and y0 is"),
        ({"a": 0.0, "b": 1.0}, {}, {"a": 5.0, "c": 2.0}, "and y0 is"),
        (np.zeros(2), {}, 5.0, "and y0 is"),
        (np.zeros(2), {}, np.zeros(3), "and y0 is"),
    ],
)
def test_a_point_where_no_search_looks_is_refused(y0, settings, point, match):
    search = sd.Search(y0, key=KEY, **settings)
    with pytest.raises(ValueError, match=match):
        search.tell([y0, point], [1.0, -7.0])
    assert (search.evaluations, search.fun) == (0, np.inf)


def test_a_list_of_points_that_is_one_point_is_refused():
    search = sd.Search(jnp.zeros(2), key=KEY)
    with pytest.raises(ValueError, match="tell a list of points"):
        search.tell(search.ask(1)[0], [1.0, 2.0])


@pytest.mark.parametrize(
    ("residuals", "values", "error", "match"),
    [
        (False, [1.0, np.zeros(3)], ValueError, "tell one number, or write residuals=True"),
        (
            True,
            [np.ones(3), np.ones(4)],
            ValueError,
            "4 residuals were told for a point, and 3 for",
        ),
        (False, [1.0, None], ValueError, "tell NaN for an evaluation that failed"),
        (False, [1.0, 1 + 2j], TypeError, "complex"),
    ],
)
def test_a_wrong_value_is_no_harm(residuals, values, error, match):
    search = sd.Search(jnp.zeros(2), key=KEY, residuals=residuals)
    points = search.ask(2)
    with pytest.raises(error, match=match):
        search.tell(points, values)
    assert search.evaluations == 0
    right = [np.array([y[0] - 1, y[1] + 2, 1, 0]) if residuals else bowl(y) for y in points]
    search.tell(points, right)
    assert search.evaluations == 2
    assert np.isfinite(search.fun)


def test_what_failed_before_a_size_was_known_waits_as_long():
    """The start fails, and so do points that the solver comes to later."""
    search = sd.Search(jnp.zeros(2), key=KEY, residuals=True)
    points = search.ask(4)
    search.tell(points[1:3], [np.nan, np.nan])
    search.tell([points[3], points[0]], [np.ones(3), np.full(3, 2.0)])
    assert (search.evaluations, search.fun) == (4, 1.5)
    assert np.isfinite(search.ask(2)).all()


@pytest.mark.parametrize("apart", [False, True])
def test_a_point_that_is_told_again_counts_again(apart):
    search = sd.Search(jnp.zeros(2), key=KEY)
    (point,) = search.ask()
    for points, values in (
        [([point], [2.0]), ([point], [3.0])] if apart else [([point] * 2, [2.0, 3.0])]
    ):
        search.tell(points, values)
    assert (search.evaluations, search.fun) == (2, 2.0)


def test_large_numbers_are_numbers():
    search = sd.Search(jnp.full(2, 3e7), key=KEY, sigma=1e6)
    search.tell([np.full(2, 3.1e7, np.float32)], [1.0])
    assert (search.evaluations, search.fun) == (1, 1.0)


@pytest.mark.parametrize("residuals", [False, True])
def test_an_empty_value_is_none(residuals):
    search = sd.Search(jnp.zeros(2), key=KEY, residuals=residuals)
    points = search.ask(2)
    with pytest.raises(ValueError, match="tell NaN for an evaluation that failed"):
        search.tell(points, [np.zeros(0), np.zeros(0)])
    search.tell(points, [np.ones(3), np.ones(3)] if residuals else [1.0, 2.0])
    assert search.evaluations == 2


def test_many_whole_numbers_are_all_different():
    for most, count in ((5, 36), (99, 150)):
        search = sd.Search({"a": 0, "b": 1}, key=KEY, space=sd.Integer(0, most))
        points = search.ask(count)
        assert len({(int(y["a"]), int(y["b"])) for y in points}) == count
    search.tell(points, [float(y["a"] + y["b"]) for y in points])
    assert search.evaluations == count


def test_whole_numbers_are_given_once_and_count_once():
    search = sd.Search({"a": 0, "b": 1}, key=KEY, space=sd.Integer(0, 5))
    points = search.ask(8)
    assert len({(int(y["a"]), int(y["b"])) for y in points}) == 8
    search.tell(points[:1], [3.0])
    assert search.evaluations == 1
    search.tell(points[1:], [float(y["a"] + y["b"]) for y in points[1:]])
    assert search.evaluations == 8
    # where there are no others they come again
    few = sd.Search(0, key=KEY, space=sd.Integer(0, 2))
    points = few.ask(6)
    assert {int(y) for y in points} == {0, 1, 2}
    few.tell(points, [float(y) for y in points])
    assert (few.evaluations, few.fun) == (6, 0.0)


@pytest.mark.parametrize("y0", [{}, None, {"a": np.zeros(0)}])
def test_a_start_without_a_number_is_an_error(y0):
    for call in (
        lambda: sd.Search(y0, key=KEY),
        lambda: sd.minimise(lambda y, _: jnp.array(1.0), y0, key=KEY),
        lambda: sd.recommend(lambda y, _: jnp.array(1.0), y0, key=KEY),
    ):
        with pytest.raises(ValueError, match="y0 is empty"):
            call()


def test_the_best_of_single_numbers_has_their_structure():
    y0 = {"rate": np.float32(0.01), "teeth": 7}
    space = {"rate": sd.Range(1e-4, 1e2, log=True), "teeth": sd.Integer(3, 20)}
    search = sd.Search(y0, key=KEY, space=space)
    points = search.ask(3)
    search.tell(points, [float(y["teeth"]) for y in points])
    assert int(search.y["teeth"]) == min(int(y["teeth"]) for y in points)
    assert jnp.shape(search.y["rate"]) == ()
