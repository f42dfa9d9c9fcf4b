"""A call of `minimise` that cannot work says what to write, and what it says works."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest

import smoothdiff as sd

KEY = jax.random.key(0)
START, GRID = jnp.zeros(2), jnp.array([[0.0, 0.0], [3.0, -1.0]])


def bowl(y, args):
    return jnp.sum((y - 1) ** 2)


def bowl_of_key(y, args, key):
    return bowl(y, args)


def message(error, call):
    with pytest.raises(error) as info:
        call()
    return str(info.value)


# JAX's transformations

TRACED = {
    "start": lambda y: sd.minimise(bowl, y, key=KEY),
    "argument": lambda y: sd.minimise(lambda y, args: bowl(y, args) + args, START, y[0], key=KEY),
    "bounds": lambda y: sd.minimise(bowl, START, key=KEY, bounds=(-y, y)),
    "sigma": lambda y: sd.minimise(bowl, START, key=KEY, sigma=y),
    "solver": lambda y: sd.minimise(bowl, START, key=KEY, solver=sd.NewtonCG(y)),
}


@pytest.mark.parametrize("transform", [jax.jit, jax.vmap])
@pytest.mark.parametrize("name", TRACED)
def test_a_call_that_is_traced_says_what_to_call(name, transform):
    run = transform(lambda y: TRACED[name](y).y)
    text = message(TypeError, lambda: run(jnp.ones((2, 2))))
    assert "call optimistix.minimise(fun, solver, y0, args, " in text


def test_under_jit_it_says_so_where_the_function_alone_is_traced():
    hidden = lambda a: sd.minimise(lambda y, args: bowl(y, args) + a, START, key=KEY).y
    assert "outside of jit" in message(TypeError, lambda: jax.jit(hidden)(1.0))


def test_what_it_says_to_call_works_there():
    residuals = lambda y, args: y - args
    text = message(
        TypeError, lambda: jax.vmap(lambda y: sd.least_squares(residuals, y, 1.0, key=KEY).y)(GRID)
    )
    call = 'optimistix.least_squares(fun, solver, y0, args, options={"key": key})'
    assert call in text
    assert "sd.GaussNewton(sigma)" in text
    names = {"optimistix": optimistix, "fun": residuals, "args": 1.0, "key": KEY}
    names["solver"] = sd.GaussNewton(0.3)
    inside = jax.jit(jax.vmap(lambda y: eval(call, names | {"y0": y}).value))
    np.testing.assert_allclose(inside(GRID), 1, atol=1e-3)


# bounds


@pytest.mark.parametrize(
    ("bounds", "low_high", "pairs"),
    [
        (
            ([0, 0], [2, 3]),
            "bounds=(jnp.array([0, 0]), jnp.array([2, 3]))",
            "bounds=(jnp.array([0, 2]), jnp.array([0, 3]))",
        ),
        (
            [(0, None), (1, 3)],
            "bounds=(jnp.array([0, -jnp.inf]), jnp.array([1, 3]))",
            "bounds=(jnp.array([0, 1]), jnp.array([jnp.inf, 3]))",
        ),
    ],
)
def test_two_pairs_for_two_parameters_can_be_read_in_two_ways(bounds, low_high, pairs):
    start = jnp.full(2, 0.5)
    for call in (
        lambda: sd.minimise(bowl, start, key=KEY, bounds=bounds),
        lambda: sd.Search(start, key=KEY, bounds=bounds),
    ):
        said = message(ValueError, call)
        assert f"If these are (low, high), write {low_high}. " in said
        assert f"as in SciPy, write {pairs}" in said


def test_integers_are_bounds():
    bounds = jnp.array([0, 0]), jnp.array([2, 3])
    search = sd.Search(jnp.full(2, 0.5), key=KEY, bounds=bounds)
    points = np.stack(search.ask(5))
    assert np.all((points >= 0) & (points <= [2, 3]))


@pytest.mark.parametrize(
    ("y0", "bounds"),
    [
        (1.0, (1.0, 1.0)),
        (jnp.ones(2), (1.0, jnp.ones(2))),
        ({"a": 1.0, "b": jnp.ones(2)}, (1.0, {"a": 1.0, "b": jnp.ones(2)})),
    ],
)
def test_bounds_with_nothing_in_between_are_refused(y0, bounds):
    for call in (
        lambda: sd.minimise(lambda y, args: 0.0, y0, key=KEY, bounds=bounds),
        lambda: sd.Search(y0, key=KEY, bounds=bounds),
    ):
        assert "nothing to search" in message(ValueError, call)


def test_some_parameters_may_have_equal_bounds():
    search = sd.Search(jnp.ones(2), key=KEY, bounds=(1.0, jnp.array([1.0, 2.0])))
    assert all(y[0] == 1 for y in search.ask(3))


# spaces


@pytest.mark.parametrize(
    ("space", "written"),
    [
        (
            [sd.Range(0, 2), sd.Range(0, 3)],
            "space, sd.Range(jnp.array([0.0, 0.0]), jnp.array([2.0, 3.0]));",
        ),
        (
            [sd.Range(1, 2, log=True), sd.Range(2, 3, log=True)],
            "space, sd.Range(jnp.array([1.0, 2.0]), jnp.array([2.0, 3.0]), log=True);",
        ),
        (
            (sd.Integer(0, 2), sd.Integer(1, 3)),
            "space, sd.Integer(jnp.array([0, 1]), jnp.array([2, 3]));",
        ),
        ([sd.Range(0, 2), None], "such as sd.Range(jnp.array([0, 0]), jnp.array([2, 3]));"),
        ([sd.Range(1, 2), sd.Range(1, 2, log=True)], "such as sd.Range("),
    ],
)
def test_a_list_of_spaces_for_one_array_is_to_be_one_space_or_a_dict(space, written):
    said = message(ValueError, lambda: sd.minimise(bowl, jnp.ones(2), key=KEY, space=space))
    assert written in said
    assert "make y0 a dict of parameters" in said


def test_the_spaces_that_are_advised_are_spaces():
    search = sd.Search(jnp.ones(2), key=KEY, space=sd.Range(jnp.array([0, 0]), jnp.array([2, 3])))
    assert np.all(np.stack(search.ask(3)) <= [2, 3])
    space = {"a": sd.Range(0, 2), "b": sd.Integer(1, 3)}
    search = sd.Search({"a": 1.0, "b": 2}, key=KEY, space=space)
    assert all(0 <= y["a"] <= 2 and y["b"] in (1, 2, 3) for y in search.ask(3))


# black boxes


def test_a_first_call_that_fails_says_to_give_out():
    def fails(y):
        raise ArithmeticError("no convergence")

    box = sd.black_box(fails, on_error="nan")
    said = message(sd.BlackBoxError, lambda: box(jnp.ones(2)))
    assert "give `out`, as sd.black_box(fun, out=0.0, ...)" in said
    assert "another start" in said
    assert jnp.isnan(sd.black_box(fails, out=0.0, on_error="nan")(jnp.ones(2)))
    assert "give `out`" not in message(sd.BlackBoxError, lambda: sd.black_box(fails)(jnp.ones(2)))


def test_a_box_that_is_made_within_the_function_is_to_be_made_outside():
    total = lambda y: np.sum(np.floor(y))
    said = message(
        TypeError,
        lambda: sd.minimise(lambda y, args: sd.black_box(total)(y), jnp.ones(2), key=KEY),
    )
    assert "make it once, outside of the function" in said


def test_a_function_of_numpy_is_told_how_to_be_wrapped():
    total = lambda y: np.sum(np.floor(y))
    start, box = jnp.ones(2), sd.black_box(total)
    calls = [
        lambda: sd.minimise(total, start, key=KEY),
        lambda: sd.minimise(box, start, key=KEY),
        lambda: sd.minimise(lambda y, args: total(y), start, key=KEY),
        lambda: sd.recommend(lambda y, args: total(y), start, key=KEY),
    ]
    for call in calls:
        said = message(TypeError, call)
        assert "box = sd.black_box(fun)" in said
        assert "lambda y, args: box(y)" in said
    of_both = sd.black_box(lambda y, args: np.sum(np.floor(y)))
    for fun in (lambda y, args: box(y), lambda y, args: of_both(y, args)):
        assert sd.recommend(fun, start, key=KEY).run == "minimise"


# keys


def test_a_key_that_is_not_one_is_told_the_keyword():
    start, calls = jnp.ones(2), [sd.minimise, sd.recommend]
    for key in (0, jax.random.split(KEY)):
        said = [message(TypeError, lambda c=c, k=key: c(bowl, start, key=k)) for c in calls]
        said.append(message(TypeError, lambda k=key: sd.Search(start, key=k)))
        said.append(
            message(TypeError, lambda k=key: sd.minimise(bowl_of_key, start, key=k, takes_key=True))
        )
        assert all("write key=jax.random.key(0)" in text for text in said)


@pytest.mark.parametrize("call", [sd.minimise, sd.least_squares, sd.Search])
def test_bounds_beside_a_space_are_refused(call):
    first = (jnp.ones(2),) if call is sd.Search else (lambda y, args: y, jnp.ones(2))
    with pytest.raises(ValueError, match="a space or bounds"):
        call(*first, key=jax.random.key(0), space=sd.Range(0.0, 2.0), bounds=(0.0, 1.0))
