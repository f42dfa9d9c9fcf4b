"""FirstOrder(adaptive=True): sigma and steps as long as the path of the gradients says."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest

import smoothdiff as sd
from smoothdiff._default_solver import default_solver
from smoothdiff._params import take_apart
from smoothdiff._solvers._path_length import PathLength

KEY = jax.random.key(5)


def scales(directions, params, evaluations):
    """The scale after gradients, one after the other."""

    def after(length, grad):
        length = length.after(params, grad, evaluations)
        return length, length.scale

    return jax.lax.scan(after, PathLength.start(params), directions)


def adam(sigma, **options):
    optim = optax.chain(optax.scale_by_adam(), optax.scale(-0.15 * sigma))
    return sd.FirstOrder(optim, sigma, adaptive=True, **options)


def solve(fun, y0, solver, steps, **options):
    options = {"key": KEY, **options}
    return optx.minimise(fun, solver, y0, None, options, max_steps=steps, throw=False)


# the rule


def test_random_directions_make_it_shorter_and_equal_ones_longer(dtype):
    """Random: the path has length one in each parameter in the mean, 0.2 less than is right."""
    n, steps, evaluations = 200, 400, 20
    params = take_apart(jnp.zeros(n, dtype), 1.0, None)
    noise = jax.random.normal(KEY, (steps, n), dtype)
    _, scale = scales(noise, params, evaluations)
    assert scale.dtype == dtype
    each = np.diff(np.log(np.asarray(scale, np.float64)))[50:]
    rate = evaluations / n
    # neighbours share their path: as many independent ones as paths
    stderr = rate / 2 * np.sqrt(2 / n) / np.sqrt(len(each) * rate / 2)
    np.testing.assert_allclose(np.mean(each), -rate / 2 * 0.2, atol=4 * stderr)
    _, scale = scales(np.broadcast_to(noise[0], (steps, n)), params, evaluations)
    assert scale[-1] > 100


def test_gradients_as_noisy_as_samples_make_them_are_right(dtype):
    """A slope that stays, seen by pairs of samples: the path is longer by as much as was counted.

    Of a direction of P pairs the part along the slope is sqrt(P / n), so that the path's squared
    length in each parameter is (1 - share) + share (2 - rate) / rate with share = P / n: near two.
    """
    n, pairs, steps = 400, 4, 1000
    params = take_apart(jnp.zeros(n, dtype), 1.0, None)
    z = jax.random.normal(KEY, (steps, pairs, n), dtype)
    slope = jnp.ones(n, dtype) / np.sqrt(n)
    length, _ = scales(jnp.einsum("spn,sp->sn", z, z @ slope), params, 2 * pairs)
    rate, share = 2 * pairs / n, pairs / n
    expected = 1 - share + share * (2 - rate) / rate
    np.testing.assert_allclose(jnp.mean(length.path**2), expected, rtol=0.25)


@pytest.mark.parametrize("factor", [1e-20, 1e20])
def test_units_of_the_function_and_of_parameters_do_not_matter(factor):
    grads = jax.random.normal(KEY, (30, 8)) * jnp.arange(1.0, 9.0)[None]
    params = take_apart(jnp.zeros(8), 1.0, None)
    _, scale = scales(grads, params, 4)
    _, other = scales(grads * factor, params, 4)
    np.testing.assert_allclose(scale, other, rtol=1e-5)
    units = jnp.geomspace(1e-3, 1e3, 8)
    _, other = scales(grads / units[None], take_apart(jnp.zeros(8), units, None), 4)
    np.testing.assert_allclose(scale, other, rtol=1e-5)


def test_slopes_that_lead_out_of_the_bounds_do_not_count():
    y = jnp.array([1.0, 1.0, 0.0, 0.0])
    params = take_apart(y, 1.0, (jnp.array([0.0, 0.0, 0.0, -9.0]), jnp.array([1.0, 9.0, 9.0, 9.0])))
    after = jax.jit(lambda grad: PathLength.start(params).after(params, grad, 2))
    # downhill is up for the first and down for the third, where their bounds are
    barred = after(jnp.array([-5.0, 1.0, 7.0, 0.0]))
    np.testing.assert_array_equal(barred.path, [0, 2, 0, 0])
    # all barred: no path, hence shorter
    assert after(jnp.array([-5.0, 0.0, 7.0, 0.0])).scale < 1


def test_sigma_grows_to_a_fifth_of_a_range_at_most():
    """Or stays what it was, if that is more."""
    # one is free, and one fixed
    bounds = jnp.array([-1.0, -1.0, -1.0, 0.0]), jnp.array([1.0, 9.0, jnp.inf, 0.0])
    for sigma, most in ((0.01, 40), (0.4, 1), (1.0, 1)):
        params = take_apart(jnp.zeros(4), sigma, bounds)
        _, scale = scales(jnp.ones((200, 4)), params, 4)
        np.testing.assert_allclose(jnp.max(scale), most, rtol=0.06)
        assert PathLength(scale[-1], params.theta).within(params) <= 1.0001 * most


def test_equal_samples_make_it_longer_and_leave_the_path():
    params = take_apart(jnp.zeros(4), 1.0, None)
    before = PathLength.start(params).after(params, jnp.ones(4), 2)
    after = before.after(params, jnp.zeros(4), 2)
    assert after.scale > before.scale
    np.testing.assert_array_equal(after.path, before.path)


# runs


def test_a_sigma_that_is_far_off_is_mended(dtype):
    """The bowl is solved as well from a hundredth of a good sigma, and from ten times of it."""
    fun = lambda y, args: jnp.sum((y - 1) ** 2)
    y0 = jnp.zeros(30, dtype)
    run = eqx.filter_jit(lambda sigma: solve(fun, y0, adam(sigma), 500).value)
    for sigma in (0.003, 0.3, 3.0):
        assert fun(run(jnp.asarray(sigma, dtype)), None) < 1e-4 * fun(y0, None)


def test_a_plateau_wider_than_sigma_is_left():
    """The nearest change is thirty sigma away; without adaption nothing would ever be seen."""
    fun = lambda y, args: jnp.sum(jnp.floor(jnp.maximum(jnp.abs(y - 5) - 2, 0)))
    y0 = jnp.zeros(2)
    far = lambda y, args: jnp.where(jnp.max(y) < 3, 9.0, fun(y, args))
    solution = solve(far, y0, adam(0.1), 200)
    assert far(solution.value, None) == 0


@pytest.mark.parametrize("target", [3.0, 0.0])
def test_it_goes_down_to_rounding_and_stays_there(target, dtype):
    """No sample may be the parameter itself, which would be refused."""
    fun = lambda y, args: jnp.sum(jnp.abs(y - target))
    solution = solve(fun, jnp.ones(2, dtype), adam(1.0), 3000)
    assert solution.result == optx.RESULTS.nonlinear_max_steps_reached
    atol = 1e-6 + 60 * float(jnp.finfo(dtype).eps)
    np.testing.assert_allclose(solution.value, target, rtol=0, atol=atol)


def test_a_corner_shrinks_steps_to_a_millionth_at_most():
    params = take_apart(jnp.zeros(3), 1.0, (0.0, 1.0))
    length, _ = scales(jnp.ones((2000, 3)), params, 3)
    np.testing.assert_allclose(length.within(params), 1e-6, rtol=1e-6)


def test_a_step_that_fails_is_followed_by_a_narrower_one():
    """Growing has led to where the function is not defined."""
    fun = lambda y, args: jnp.where(jnp.max(jnp.abs(y)) > 9, jnp.nan, jnp.sum((y - 5) ** 2))
    solver = adam(8.0, nonfinite="drop")
    solution = solve(fun, jnp.zeros(2), solver, 200)
    assert solution.result == optx.RESULTS.nonlinear_max_steps_reached
    np.testing.assert_allclose(solution.value, 5, atol=0.1)


@pytest.mark.slow
def test_a_schedule_is_multiplied_as_well():
    fun = lambda y, args: jnp.sum(y)
    run = lambda sigma: sd.minimise(
        fun, jnp.zeros(30), key=KEY, solver=sd.FirstOrder(optax.sgd(0.0), sigma, adaptive=True)
    )
    constant, falling = run(1.0).history, run(lambda step: 1 / (1 + step)).history
    for step in (0, 10, 100):
        np.testing.assert_allclose(
            falling[step].sigma * (1 + step), constant[step].sigma, rtol=1e-3
        )


def test_leaves_without_a_sigma_take_the_steps_of_the_transformation():
    """Their gradient is AD's, and they are in no path."""
    fun = lambda y, args: jnp.sum(jnp.floor(4 * y["a"] ** 2)) + jnp.sum(y["b"])
    y0 = {"a": jnp.ones(3), "b": jnp.ones(2)}
    solver = sd.FirstOrder(optax.sgd(0.01), {"a": 0.3, "b": None}, adaptive=True)
    options = {"key": KEY}
    scalar = jax.ShapeDtypeStruct((), jnp.float32)
    fn = lambda y, args: (fun(y, args), None)

    @eqx.filter_jit
    def step(solver, scale):
        state = solver.init(fn, y0, None, options, scalar, None, frozenset())
        state = eqx.tree_at(lambda s: s.length.scale, state, scale)
        return solver.step(fn, y0, None, options, state, frozenset())

    y, after, _ = step(solver, jnp.asarray(0.5))
    np.testing.assert_allclose(y["b"], 1 - 0.01, rtol=1e-6)
    assert after.length is not None
    assert after.length.path.shape == (3,)
    assert after.progress.sigma == jnp.float32(0.15)
    narrow = sd.FirstOrder(optax.sgd(0.005), {"a": 0.15, "b": None}, adaptive=True)
    np.testing.assert_allclose(step(narrow, jnp.asarray(1.0))[0]["a"], y["a"], rtol=1e-6)


@pytest.mark.slow
def test_many_starts_at_once():
    fun = lambda y, args: jnp.sum(jnp.abs(y))
    one = lambda y: solve(fun, y, adam(0.5), 20).value
    starts = jnp.array([[1.0, 2.0], [-3.0, 0.5]])
    together = jax.jit(jax.vmap(one))(starts)
    np.testing.assert_allclose(together, jnp.stack([one(y) for y in starts]), rtol=1e-4, atol=1e-5)


# the default


def test_the_default_of_many_parameters_adapts_unless_sigma_is_a_schedule():
    y0 = jnp.zeros(100)
    assert default_solver(y0, None, None, False).adaptive
    assert not default_solver(y0, None, optax.constant_schedule(0.1), False).adaptive


@pytest.mark.slow
@pytest.mark.parametrize("bounds", [None, (-2.0, 2.0)])
def test_many_parameters_need_no_schedule(bounds):
    """Within bounds a constant sigma of a fifth of the range left a twentieth of these."""
    target = jax.random.uniform(KEY, (120,), minval=-0.5, maxval=0.5)
    y0 = jax.random.uniform(jax.random.key(1), (120,), minval=-1.5, maxval=1.5)
    for fun in (
        lambda y, args: jnp.sum((y - target) ** 2),
        lambda y, args: jnp.sum(jnp.floor(jnp.abs(y - target) * 20) ** 2),
    ):
        result = sd.minimise(fun, y0, key=KEY, bounds=bounds, max_evaluations=3630)
        assert result.fun < 1e-3 * fun(y0, None)
