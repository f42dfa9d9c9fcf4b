"""`check_gradient`: right gradients pass, wrong ones are found, entry by entry."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import smoothdiff as sd
from tests.closed_forms import as_users_have_it
from tests.parts import quick_of

A = jnp.asarray(np.random.default_rng(0).normal(size=(5, 4)), jnp.float32)
Y = jnp.asarray([0.3, -0.7, 1.1, 0.2], jnp.float32)
SIGMA = 0.2


def wave(y):
    return jnp.sum(jnp.sin(A @ y)) + 0.5 * jnp.sum(y**2)


def stairs(y):
    """What AD sees of it is the square alone."""
    return jnp.sum(y**2) + jnp.sum(jnp.floor(3 * y))


def edge(y):
    """A disc whose area counts, which moves across pixels, and shading within."""
    at = jnp.linspace(-2, 2, 24, dtype=y.dtype)
    x, z = at[:, None], at[None]
    inside = (x - y[0]) ** 2 + (z - y[1]) ** 2 < 0.6 + 0.1 * y[2]
    return jnp.mean(jnp.where(inside, y[3] + 0.3 * x, 0.1 * y[2]))


def noise(y):
    """A number that differs from point to point, as of a renderer with a seed."""
    bits = jax.lax.bitcast_convert_type(jnp.sum(y * jnp.asarray([1.0, 1.3, 1.7, 2.1])), jnp.int32)
    return wave(y) + 0.02 * jax.random.normal(jax.random.key(bits))


def stairs_gradient(y):
    """That of the smoothed stairs, whose floors are a slope but for a part in a thousand."""
    return 2 * y + 3


grad = jax.grad(wave)
ad = lambda fun: jax.grad(fun)
# compiled once for all seeds
WAVE, STAIRS, EDGE, NOISE = map(jax.jit, (wave, stairs, edge, noise))
sign = lambda y: grad(y).at[2].multiply(-1)
GRADIENTS = {
    "wave, by AD": (grad, WAVE, []),
    "wave, by hand": (lambda y: A.T @ jnp.cos(A @ y) + y, WAVE, []),
    "wave, of another point": (lambda y: grad(y + 0.3), WAVE, [0, 1, 2, 3]),
    "wave, a sign": (sign, WAVE, [2]),
    "wave, a factor": (lambda y: 2 * grad(y), WAVE, [0, 1, 2, 3]),
    "wave, an entry forgotten": (lambda y: grad(y).at[1].set(0), WAVE, [1]),
    "wave, two entries swapped": (lambda y: grad(y)[jnp.array([1, 0, 2, 3])], WAVE, [0, 1]),
    "wave, a part stopped": (lambda y: A.T @ jnp.cos(A @ y), WAVE, [0, 1, 2, 3]),
    "stairs, by AD": (ad(stairs), STAIRS, [0, 1, 2, 3]),
    "stairs, smoothed": (stairs_gradient, STAIRS, []),
    "edge, by AD": (ad(edge), EDGE, [0, 2]),
    "noise, by AD": (grad, NOISE, []),
    "noise, a sign": (sign, NOISE, [2]),
}


COMPILED = {name: jax.jit(gradient) for name, (gradient, _, _) in GRADIENTS.items()}


def checked(name, seed, num_samples=1024):
    _, fun, wrong = GRADIENTS[name]
    key = jax.random.key(seed)
    found = sd.check_gradient(COMPILED[name], fun, Y, SIGMA, key=key, num_samples=num_samples)
    return found, wrong


@pytest.mark.parametrize("name", quick_of(GRADIENTS, list(GRADIENTS)[::5]))
def test_wrong_entries_are_found_and_no_others(name):
    alarms = 0
    for seed in range(3):
        found, wrong = checked(name, seed)
        called = set(np.flatnonzero(found.wrong))
        assert set(wrong) <= called
        alarms += called != set(wrong)
        assert found.passed == (not np.any([found.wrong, found.undecided]))
        assert found.evaluations == 1024
    # one of twenty is right to be called wrong; that two of three are has a chance of 0.7 %
    assert alarms <= 1


def test_the_interval_holds_as_often_as_it_says():
    # of 60 right gradients 3 are to be called wrong; three standard errors are 5
    fun, gradient = jax.jit(stairs), jax.jit(stairs_gradient)
    runs = [
        sd.check_gradient(gradient, fun, Y, 1.0, key=jax.random.key(seed), num_samples=64)
        for seed in range(60)
    ]
    alarms = sum(bool(np.any(run.wrong)) for run in runs)
    assert alarms <= 60 * 0.05 + 3 * np.sqrt(60 * 0.05 * 0.95)


def test_the_gradient_of_the_smoothed_function_comes_with_it():
    found, _ = checked("wave, a sign", 1)
    # E[sin(a.y)] falls by exp(-sigma^2 |a|^2 / 2)
    fall = jnp.exp(-(SIGMA**2) * jnp.sum(A**2, axis=1) / 2)
    true = A.T @ (fall * jnp.cos(A @ Y)) + Y
    tolerance = 4 * np.max(np.asarray(found.high) - np.asarray(found.low)) / 5
    np.testing.assert_allclose(found.gradient, true, atol=tolerance)


def test_parameters_are_a_pytree():
    fun = jax.jit(lambda y: jnp.sum(jnp.sin(y["a"])) * y["b"])
    y, sigma = {"a": jnp.ones((2, 2)), "b": 2.0}, {"a": 0.1, "b": 0.3}
    gradient = jax.jit(lambda y: {**jax.grad(fun)(y), "b": 0.0})
    found = sd.check_gradient(gradient, fun, y, sigma, key=jax.random.key(0))
    assert found.wrong["b"]
    assert not np.any(found.wrong["a"])
    assert found.gradient["a"].shape == (2, 2)
    lines = str(found).splitlines()
    assert lines[0].startswith("y['b']: wrong")
    assert len(lines) == 5
    assert "y['a'][1, 0]: right" in str(found)


def test_host_functions_and_double_precision():
    with jax.enable_x64(True):
        gradient = lambda y: 2 * np.asarray(y)
        key = jax.random.key(0)
        square = lambda y: float(np.sum(np.asarray(y) ** 2))
        y = np.arange(3.0)
        assert sd.check_gradient(gradient, square, y, 0.1, key=key, num_samples=64).passed


def test_what_rounding_hides_is_not_called_right():
    """Beside an offset of a million a slope of one is no more than rounding in float32."""
    beside = lambda y: 1e6 + float(y)
    found = sd.check_gradient(lambda y: jnp.float32(-1.0), beside, 0.0, 0.1, key=jax.random.key(0))
    assert not found.passed
    assert found.undecided
    assert found.low < 0 < found.high


@pytest.mark.parametrize(("claimed", "passed"), [(0.0, True), (0.1, False)])
def test_of_a_constant_the_gradient_is_zero(claimed, passed, key):
    slope = lambda y: np.full(2, claimed)
    found = sd.check_gradient(slope, lambda y: 3.0, jnp.ones(2), 0.5, key=key, num_samples=64)
    assert found.passed == passed


@pytest.mark.parametrize("claimed", [0.0, 0.1])
def test_a_slope_that_rounding_all_but_hides_is_undecided(claimed, key):
    """A sigma along it is less than the spacing of float32 beside a million."""
    beside = lambda y: np.float32(1e6) + np.float32(0.1) * np.asarray(y)
    found = sd.check_gradient(lambda y: claimed, beside, 0.0, 0.5, key=key, num_samples=64)
    assert found.undecided


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"num_samples": 8}, "take 32 or more"),
        ({"level": 5}, "between 0 and 1"),
        ({"grad_fun": lambda y: y[:2]}, "pytree like y"),
        ({"fun": lambda y: y}, "one number"),
        ({"fun": lambda y: jnp.log(-jnp.sum(y**2))}, "not finite"),
        ({"sigma": 0.0}, "must be positive"),
    ],
)
def test_wrong_arguments_say_what_to_write(changed, message):
    usual = {"grad_fun": grad, "fun": wave, "y": Y, "sigma": SIGMA} | changed
    check = as_users_have_it(sd.check_gradient)
    with pytest.raises(ValueError, match=message):
        check(**usual, key=jax.random.key(0))


def test_half_a_sample_is_refused():
    check = as_users_have_it(sd.check_gradient)
    with pytest.raises(TypeError, match=r"num_samples must be a whole number, not 64\.5"):
        check(grad, wave, Y, SIGMA, key=jax.random.key(0), num_samples=64.5)


@pytest.mark.parametrize("fun", [lambda y: jnp.sum(y**2), lambda y: 1 + jnp.sum(jnp.cos(y))])
def test_a_gradient_that_vanishes_can_pass(fun, key):
    right = jax.jit(jax.grad(fun))
    check = lambda grad: sd.check_gradient(grad, jax.jit(fun), jnp.zeros(2), 0.1, key=key)
    assert check(right).passed
    found = check(lambda y: right(y) + jnp.array([0.1, 0.0]))
    assert list(found.wrong) == [True, False]
