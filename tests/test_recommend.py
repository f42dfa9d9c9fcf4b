"""What is recommended, and what a few evaluations show of a function."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import as_users_have_it

import smoothdiff as sd
from smoothdiff._look_around import look_around

KEY = jax.random.key(0)
recommend = as_users_have_it(sd.recommend)


def bowl(y, _):
    return jnp.sum((y - 2) ** 2)


def stairs(y, _):
    return jnp.sum(jnp.floor(4 * jnp.abs(y - 2.1)))


def looked(fun, sigma=0.2):
    """At (1, 1), with a function of NumPy that returns residuals."""
    rows = lambda points: np.stack([np.atleast_1d(fun(y)) for y in points])
    here, directions = np.ones(2), np.eye(2)
    return look_around(rows, here, np.full(2, sigma), lambda p: p, directions, np.ones(2))


def said(lines, *words):
    """Whether one line has all these words."""
    return any(all(word in line for word in words) for line in lines)


def test_a_smooth_function():
    advice = recommend(bowl, jnp.ones(2), key=KEY)
    assert isinstance(advice.solver, sd.NewtonCG)
    assert (advice.run, advice.evaluations, advice.max_evaluations) == ("minimise", 12, 611)
    np.testing.assert_allclose(advice.sigma, 0.2)
    assert said(advice.seen, "no noise")
    assert said(advice.seen, "smooth")
    assert said(advice.seen, "within sigma: y[0] 0.44, y[1] 0.44")
    assert not said(advice.seen, "jumps")
    text = str(advice)
    assert text.startswith("sd.minimise with NewtonCG, sigma 0.2, at most 611 evaluations\nSeen at")
    assert all(f"- {line}\n" in text + "\n" for line in (*advice.seen, *advice.advice))


def test_evaluations_are_those_that_it_states():
    calls = []

    def fun(y):
        calls.append(y)
        return np.array([y[0] - 1, y[1], 2.0], np.float32)

    for out, extra in ((jax.ShapeDtypeStruct((3,), jnp.float32), 0), (None, 1)):
        calls.clear()
        box = sd.black_box(fun, out)
        advice = recommend(lambda y, _: box(y), jnp.ones(2), key=KEY)  # noqa: B023
        assert len(calls) == advice.evaluations == 2 + 4 + 6 + extra
        assert isinstance(advice.solver, sd.GaussNewton)
        assert advice.run == "least_squares"


def test_residuals_with_a_dead_parameter_and_the_names_of_spaces():
    fun = lambda y, data: jnp.stack([jnp.log(y["r"]) - data, 3 * y["k"], y["k"] - 1])
    space = {"r": sd.Range(1e-3, 10.0, log=True, label="rate"), "k": None, "dead": None}
    y0 = {"r": 0.1, "k": 0.5, "dead": 3.0}
    advice = recommend(fun, y0, jnp.asarray(2.0), key=KEY, space=space)
    assert said(advice.seen, "dead changes nothing")
    assert said(advice.seen, "within sigma: rate 3.7, k 0.32, dead 0")
    assert said(advice.advice, "a larger sigma for dead")
    assert {name: round(float(s), 3) for name, s in advice.sigma.items()} == {
        "r": 0.4,
        "k": 0.1,
        "dead": 0.6,
    }


@pytest.mark.slow
def test_a_plateau_gets_a_larger_sigma():
    fun = lambda y, _: jnp.floor(jnp.linalg.norm(y - 5.3))
    advice = recommend(fun, jnp.zeros(2), key=KEY, sigma=0.02)
    assert said(advice.seen, "plateau")
    np.testing.assert_allclose(advice.sigma, 1.28, rtol=1e-6)
    result = sd.minimise(fun, jnp.zeros(2), key=KEY, solver=advice.solver)
    assert result.fun == 0
    flat = recommend(lambda y, _: 0 * jnp.sum(y), jnp.zeros(2), key=KEY)
    assert said(flat.seen, "plateau", "within 64 sigma")
    assert flat.evaluations == 12


def test_noise():
    rng = np.random.default_rng(0)
    view = looked(lambda y: np.sum(y**2) + 0.1 * rng.standard_normal())
    assert 0.01 < view.noise < 0.5
    assert view.jumps is None
    assert view.evaluations == 8
    box = sd.black_box(
        lambda y: np.float32(np.sum(y**2) + rng.standard_normal()),
        jax.ShapeDtypeStruct((), jnp.float32),
    )
    advice = recommend(lambda y, _: box(y), jnp.zeros(2), key=KEY, sigma=0.01)
    assert said(advice.seen, "noise: the same point twice differs by")
    assert said(advice.advice, "a larger sigma")


@pytest.mark.parametrize(
    ("fun", "jumps"),
    [
        (lambda y: np.floor(5 * y[0]) + y[1], True),
        (lambda y: np.floor(30 * y), True),
        (lambda y: y[0] + (y[0] > 1.1) * 0.3, True),
        (lambda y: np.where(np.abs(np.linspace(0, 2, 200) - y[0]) < 0.5, 1.0, 0.0), True),
        (lambda y: np.exp(20 * y), False),
        (lambda y: np.abs(y - 1.1), False),
        (lambda y: np.sin(20 * y), False),
        (lambda y: 1e3 + 1e-12 * y, None),
    ],
)
def test_jumps_are_told_from_slopes(fun, jumps):
    view = looked(fun)
    assert view.jumps is jumps
    assert view.evaluations == 12


def test_stairs_and_scales_in_words():
    advice = recommend(stairs, jnp.ones(2), key=KEY)
    assert said(advice.seen, "jumps")
    assert said(advice.advice, "no smaller sigma")
    fun = lambda y, _: jnp.stack([1e4 * (y[0] - 2), y[1] - 2])
    advice = recommend(fun, jnp.ones(2), key=KEY)
    assert said(advice.seen, "scales", "y[0]", "1e+04 times", "y[1]")
    assert said(advice.advice, "a smaller sigma for y[0]")
    assert not said(recommend(bowl, jnp.ones(2), key=KEY).seen, "scales")


def test_what_is_not_finite():
    fun = lambda y, _: jnp.where(y[0] > 1.1, jnp.nan, jnp.sum(y**2))
    advice = recommend(fun, jnp.ones(2), key=KEY)
    assert said(advice.seen, "not finite along y[0]")
    assert advice.solver.nonfinite == "drop"
    assert sd.minimise(fun, jnp.ones(2), key=KEY, solver=advice.solver).fun < 1e-6
    nowhere = recommend(fun, jnp.full(2, 2.0), key=KEY)
    assert said(nowhere.seen, "not finite at y0")
    assert nowhere.evaluations == 2


def test_bounds_hold_and_leave_one_side():
    seen = []

    def fun(y):
        seen.append(np.array(y))
        return np.float32(np.sum(y))

    box = sd.black_box(fun, jax.ShapeDtypeStruct((), jnp.float32))
    advice = recommend(lambda y, _: box(y), jnp.ones(2), key=KEY, bounds=(0.0, 1.0))
    assert np.max(seen) <= 1
    assert said(advice.seen, "y[0] 0.2, y[1] 0.2")


def test_many_parameters_are_looked_at_in_few_directions():
    advice = recommend(lambda y, _: jnp.sum((y - 1) ** 2), jnp.zeros(1000), key=KEY)
    assert isinstance(advice.solver, sd.FirstOrder)
    assert advice.evaluations == 2 + 16 + 6
    advice = recommend(lambda y, _: y - 1, jnp.zeros(1000), key=KEY)
    assert said(advice.advice, "support")
    assert len(str(advice)) < 500


@pytest.mark.parametrize(
    ("call", "error", "match"),
    [
        (lambda: recommend(lambda y: y, 1.0, key=KEY), TypeError, "write lambda y, args"),
        (
            lambda: recommend(lambda y, _: np.sin(float(y[0])), jnp.ones(2), key=KEY),
            TypeError,
            r"sd\.black_box",
        ),
        (
            lambda: recommend(lambda y, _: y.astype(int), jnp.ones(2), key=KEY),
            TypeError,
            "floating-point",
        ),
        (lambda: recommend(bowl, jnp.ones(2), key=None), TypeError, "random key"),
        (
            lambda: recommend(bowl, jnp.ones(2), key=KEY, sigma=[1.0, 1.0]),
            ValueError,
            "sigma must be a number",
        ),
    ],
)
def test_wrong_arguments_are_told_what_to_write(call, error, match):
    with pytest.raises(error, match=match):
        call()


def test_both_precisions(dtype):
    advice = recommend(bowl, jnp.ones(2), key=KEY)
    assert advice.sigma.dtype == dtype
    assert said(advice.seen, "smooth")


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_the_scale_of_the_function_does_not_matter(scale):
    y0 = jnp.array([0.5, 1.0])
    usual = recommend(bowl, y0, key=KEY)
    found = recommend(lambda y, _: scale * bowl(y, _), y0, key=KEY)
    assert (len(found.seen), found.seen[-1], found.advice) == (
        len(usual.seen),
        usual.seen[-1],
        usual.advice,
    )


def test_where_no_neighbour_has_a_value_nothing_is_called_a_plateau():
    y0 = jnp.array([0.5, 1.0])
    found = recommend(lambda y, _: jnp.where(jnp.all(y == y0), 1.0, jnp.nan), y0, key=KEY)
    assert "plateau" not in str(found)
    assert "not finite" in str(found)


@pytest.mark.parametrize("start", [0, 1])
def test_a_whole_number_of_two_matters_from_either_side(start):
    space = {"k": sd.Integer(0, 1), "x": sd.Range(0, 1)}
    fun = lambda y, _: (y["x"] - 0.3) ** 2 + jnp.where(y["k"] > 0, 1.0, 0.0)
    found = recommend(fun, {"k": start, "x": 0.8}, key=KEY, space=space)
    assert "k 1," in str(found)
