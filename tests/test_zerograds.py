"""ZeroGrads: its estimator against quadrature, what it converges to, accepts and refuses."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest
from jax.flatten_util import ravel_pytree

import smoothdiff as sd
from smoothdiff._params import take_apart
from smoothdiff._solvers._locality import share
from smoothdiff._solvers._replay import Replay
from smoothdiff._solvers._surrogate_fit import surrogate_loss
from smoothdiff._solvers.zerograds import ZeroGrads
from smoothdiff.surrogates import MLP, Quadratic

KEY = jax.random.key(2)
TARGET = jnp.array([0.6, -0.4])
SMALL = functools.partial(MLP, width=16, depth=1, activation=jnp.tanh)
# large steps on a small network: a test has no time for a careful fit
QUICK: dict[str, Any] = {
    "surrogate": SMALL,
    "surrogate_steps": 3,
    "replay": 5,
    "surrogate_optimizer": optax.adam(0.01),
    "optimizer": optax.adam(0.01),
}
SUCCESS, MAX_STEPS, NONFINITE = (
    optx.RESULTS.successful,
    optx.RESULTS.nonlinear_max_steps_reached,
    optx.RESULTS.nonfinite,
)


def names(value):
    """Ids without addresses: the parallel runs of the tests must agree on them."""
    return " ".join(value) if isinstance(value, dict) else ""


def plateaus(y, target):
    return jnp.sum(jnp.floor(8 * jnp.abs(y - target)))


def bowl(y, target):
    return jnp.sum((y - target) ** 2)


def run(fun, solver, y0, args=TARGET, *, bounds=None, steps=300, key=KEY, **rest):
    options = {"key": key} if bounds is None else {"key": key, "bounds": bounds}
    return optx.minimise(fun, solver, y0, args, options, max_steps=steps, throw=False, **rest)


def started(fun, solver, y0, options):
    """The function, and the state before the first step."""
    fn, scalar = lambda y, args: (fun(y, args), None), jax.ShapeDtypeStruct((), y0.dtype)
    return fn, solver.init(fn, y0, None, options, scalar, None, frozenset())


# the estimator: Algorithm 2 against eq. 2, whose gradient is taken by quadrature

SIGMA, INNER = 0.4, 0.15
THETA = np.array([0.1, -0.3])


def jumps(x, args=None):
    """Discontinuous, neither odd nor even, and not a sum over the numbers."""
    return jnp.sum(jnp.where(x > 0.1, 1.0, 0.0)) + 2 * jnp.prod(x + 0.5)


def smoothed_jumps(x):
    """The same after the smoothing kernel, in closed form."""
    return jnp.sum(jax.scipy.special.ndtr((x - 0.1) / INNER)) + 2 * jnp.prod(x + 0.5)


def quadrature_loss(weights, rest, place, up_to_constant):
    """The integral over rho of the squared error of the fit to the smoothed function."""
    size = 1 if place == "1-D" else 2
    z = np.linspace(-7, 7, 2001 if size == 1 else 201)
    w = np.exp(-z * z / 2)
    grid = np.stack(np.meshgrid(*[z] * size, indexing="ij"), -1).reshape(-1, size)
    w = functools.reduce(np.multiply.outer, [w / w.sum()] * size).reshape(-1)
    rho = jnp.asarray(THETA[None, :size] + SIGMA * grid)
    surrogate = eqx.combine(weights, rest)
    error = jax.vmap(surrogate)(rho) - jax.vmap(smoothed_jumps)(rho)
    mean = jnp.sum(w * error) if up_to_constant else 0
    return jnp.sum(w * (error - mean) ** 2)


@pytest.mark.parametrize(
    ("place", "surrogate"),
    [("1-D", SMALL), ("2-D", SMALL), ("2-D", Quadratic)],
    ids=["1-D", "2-D", "2-D quadratic"],
)
@pytest.mark.parametrize("how", ["pairs", "sobol", "up to a constant"])
def test_the_gradient_of_the_surrogate_is_unbiased(place, surrogate, how, x64):
    size = 1 if place == "1-D" else 2
    theta, up_to_constant, num = jnp.asarray(THETA[:size]), how == "up to a constant", 4
    sampler = {"sobol": sd.Sobol(), "pairs": sd.Gaussian(antithetic=True)}.get(how, sd.Gaussian())
    solver = ZeroGrads(SIGMA, inner_sigma=INNER, num_samples=num, sampler=sampler)
    weights, rest = eqx.partition(surrogate(size, key=jax.random.key(1)), eqx.is_inexact_array)
    params, step = take_apart(theta, SIGMA, None), jnp.asarray(0)

    def estimate(key):
        fn = lambda y: (jumps(y), None)
        locality = solver._locality(params, theta, step, {"key": key})
        rho, batch = locality.around(fn)

        def loss(weights):
            made = eqx.combine(weights, rest)
            return surrogate_loss(made, rho, batch.values, share(batch), up_to_constant)

        return ravel_pytree(jax.grad(loss)(weights))[0]

    estimates = jax.jit(jax.vmap(estimate))(jax.random.split(KEY, 20_000))
    exact = jax.grad(quadrature_loss)(weights, rest, place, up_to_constant)
    # N independent errors vary by (N - 1)/N of their variance around their own mean
    exact = ravel_pytree(exact)[0] * ((num - 1) / num if up_to_constant else 1)
    stderr = jnp.std(estimates, axis=0) / np.sqrt(len(estimates))
    off = jnp.abs(jnp.mean(estimates, axis=0) - exact)
    assert jnp.all(off < 4.5 * stderr + 1e-7)
    # and the tolerance means something
    assert jnp.linalg.norm(stderr) < 0.05 * jnp.linalg.norm(exact)


def test_pairs_mirror_both_kernels_together():
    solver = ZeroGrads(SIGMA, inner_sigma=INNER, num_samples=6)
    fn = lambda y: (bowl(y, TARGET), None)
    params = take_apart(jnp.asarray(THETA, jnp.float32), SIGMA, None)
    locality = solver._locality(params, params.theta, jnp.asarray(0), {"key": KEY})
    rho, _ = locality.around(fn)
    middle = (rho[0::2] + rho[1::2]) / 2
    np.testing.assert_allclose(middle, np.tile(params.theta, (3, 1)), atol=1e-6)


def test_replayed_samples_stand_for_the_present_neighbourhood():
    """Weighted by the ratio of densities they have its moments; a weight is at most a share."""
    old, new, width = (jnp.array([v]) for v in (0.3, 0.0, 1.0))
    u = old[None] + 2 * jax.random.normal(KEY, (20_000, 1))
    density = lambda u, center, width: -(((u - center) / width) ** 2).sum() / 2 - jnp.log(width)[0]
    drawn = jax.vmap(lambda u: density(u, old, 2 * width))(u)
    share = jnp.full(len(u), 1 / len(u))
    replay = Replay.start(2, len(u), old, jnp.float32).after(
        jnp.asarray(0), u, u[:, 0], share, drawn
    )
    now = jax.vmap(jax.vmap(lambda u: density(u, new, width)))(replay.u)
    # no cap is met where the present density is lower than the other by a factor
    weights = replay.weights(now - 5)
    np.testing.assert_allclose(jnp.sum(weights), 1, rtol=1e-5)
    np.testing.assert_array_equal(weights[1], 0)
    mean = jnp.sum(weights[0] * u[:, 0])
    np.testing.assert_allclose(mean, 0, atol=0.05)
    np.testing.assert_allclose(jnp.sum(weights[0] * u[:, 0] ** 2), 1, atol=0.1)
    capped = replay.weights(now)
    assert jnp.max(capped) <= 1.01 * jnp.min(capped[0][drawn <= now[0]])


def test_the_newest_batch_has_its_shares_and_the_oldest_goes():
    u, share = jnp.ones((2, 3)), jnp.full(2, 0.5)
    replay = Replay.start(2, 2, u[0], jnp.float32)
    for step in range(3):
        values = jnp.full(2, float(step))
        replay = replay.after(jnp.asarray(step), u * step, values, share, jnp.zeros(2))
    np.testing.assert_array_equal(replay.values[:, 0], [2, 1])
    np.testing.assert_allclose(replay.weights(jnp.zeros((2, 2))), jnp.full((2, 2), 0.25))
    far = jnp.array([[0.0, 0.0], [-1e4, -1e4]])
    np.testing.assert_allclose(replay.weights(far), [[0.5, 0.5], [0, 0]])


# what it finds


def test_crosses_plateaus_in_both_precisions(dtype):
    solution = run(plateaus, ZeroGrads(0.3, **QUICK), jnp.zeros(2, dtype), TARGET.astype(dtype))
    assert solution.value.dtype == solution.stats["fun"].dtype == dtype
    np.testing.assert_allclose(solution.value, TARGET, atol=0.1)
    assert solution.result == MAX_STEPS
    assert solution.stats["evaluations"] == 300 * 2 + 2 * 2
    weights = jax.tree.leaves(solution.state.fit.weights)
    assert all(w.dtype == dtype for w in weights)


@pytest.mark.parametrize(
    "change",
    [
        {"inner_sigma": 0.0},
        {"surrogate": Quadratic},
        {"up_to_constant": False},
        {"sampler": sd.Sobol(), "num_samples": 4},
        {"log": True},
        {"surrogate_steps": 1, "parameter_steps": 2},
        {"replay": 0, "up_to_constant": True},
    ],
    ids=names,
)
def test_every_configuration_descends(change):
    solution = run(bowl, ZeroGrads(0.3, **{**QUICK, **change}), jnp.zeros(2))
    assert bowl(solution.value, TARGET) < 0.1 * bowl(jnp.zeros(2), TARGET)


def test_without_locality_it_samples_all_that_is_within_the_bounds():
    low, high = jnp.array([-1.0, 2.0]), jnp.array([1.0, 6.0])
    solver = ZeroGrads(0.1, local=False, num_samples=2000)
    y, bounds = jnp.array([0.5, 3.0]), (low, high)
    params = take_apart(y, 0.1, bounds)
    fn = lambda y: (bowl(y, TARGET), None)
    options = {"key": KEY, "bounds": bounds}
    rho, _ = solver._locality(params, y, jnp.asarray(0), options).around(fn)
    assert jnp.all((low[None] < rho) & (rho < high[None]))
    share = (rho - low[None]) / (high - low)[None]
    np.testing.assert_allclose(jnp.mean(share, axis=0), 0.5, atol=1e-6)
    # 4 standard errors of the second moment of a uniform number, 1/12, whose fourth is 1/80
    spread = 4 * np.sqrt((1 / 80 - 1 / 144) / 1000)
    np.testing.assert_allclose(jnp.mean((share - 0.5) ** 2, axis=0), 1 / 12, atol=spread)


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_the_run_does_not_depend_on_the_scale_of_the_function(scale):
    solver = ZeroGrads(0.3, **QUICK)
    plain = run(bowl, solver, jnp.zeros(2), steps=50)
    scaled = run(lambda y, t: jnp.float32(scale) * bowl(y, t), solver, jnp.zeros(2), steps=50)
    np.testing.assert_allclose(scaled.value, plain.value, atol=1e-3)


def test_a_large_offset_leaves_only_its_own_rounding():
    solver = ZeroGrads(0.3, **QUICK)
    solution = run(lambda y, t: 1e4 + 8 * bowl(y, t), solver, jnp.zeros(2))
    np.testing.assert_allclose(solution.value, TARGET, atol=0.15)


def test_sigma_and_its_units_scale_the_run():
    """The surrogate sees units of sigma: other units give the same run."""
    solver = ZeroGrads({"a": 0.3, "b": 30.0}, surrogate=SMALL)
    fun = lambda y, t: bowl(jnp.stack([y["a"], y["b"] / 100]), t)
    same = ZeroGrads({"a": 0.3, "b": 0.3}, surrogate=SMALL)
    plain = lambda y, t: bowl(jnp.stack([y["a"], y["b"]]), t)
    y0 = {"a": jnp.float32(0.0), "b": jnp.float32(0.0)}
    one, two = (run(f, s, y0, steps=40).value for f, s in [(fun, solver), (plain, same)])
    np.testing.assert_allclose(one["a"], two["a"], rtol=1e-3)
    np.testing.assert_allclose(one["b"], 100 * two["b"], rtol=1e-3)


def test_bounds_hold_for_the_iterates_and_for_what_the_function_sees():
    seen = []
    host = lambda y: seen.append(np.array(y)) or np.float32(np.sum((y - 2.0) ** 2))
    box = sd.black_box(host, jax.ShapeDtypeStruct((), jnp.float32))
    records = []
    result = sd.minimise(
        lambda y, args: box(y),
        jnp.zeros(2),
        key=KEY,
        solver=ZeroGrads(0.3, **QUICK),
        max_steps=60,
        bounds=(-0.1, jnp.array([0.3, 0.2])),
        callback=records.append,
    )
    np.testing.assert_allclose(result.y, [0.3, 0.2], atol=0.05)
    points = np.stack(seen)
    assert len(points) == result.evaluations
    high = np.array([0.3, 0.2], np.float32)
    assert np.all((points >= np.float32(-0.1)) & (points <= high))
    assert all(np.all(r.y <= high) for r in records)


def test_line_searches_on_the_surrogate_cost_no_evaluation():
    search = optax.chain(optax.sgd(0.05), optax.scale_by_backtracking_linesearch(5))
    solution = run(bowl, ZeroGrads(0.3, **{**QUICK, "optimizer": search}), jnp.zeros(2))
    assert solution.stats["evaluations"] == 2 * 300 + 4
    assert bowl(solution.value, TARGET) < 0.1 * bowl(jnp.zeros(2), TARGET)


# how it runs


def test_iterates_are_those_of_minimise_to_the_last_bit(dtype, tmp_path):
    y0, bounds = {"a": jnp.zeros(2, dtype), "b": [jnp.zeros((), dtype)]}, (-1.0, 0.5)
    fun = lambda y, t: bowl(y["a"], t) + jnp.floor(4 * jnp.abs(y["b"][0] - 0.25))
    solver = ZeroGrads(optax.linear_schedule(0.3, 0.1, 30), **QUICK)
    target = TARGET.astype(dtype)
    solution = run(fun, solver, y0, target, bounds=bounds, steps=30)
    go = functools.partial(sd.minimise, fun, y0, target, key=KEY, solver=solver, bounds=bounds)
    result = go(max_steps=30)
    jax.tree.map(np.testing.assert_array_equal, result.y, solution.value)
    assert (result.fun, result.evaluations) == (solution.stats["fun"], 30 * 2 + 4)
    # a run that is taken up again ends the same
    path = tmp_path / "run.npz"
    go(max_steps=12, checkpoint=path)
    again = go(max_steps=30, checkpoint=path)
    jax.tree.map(np.testing.assert_array_equal, again.y, result.y)
    assert again.fun == result.fun
    assert len(again.history) == 30


def test_vmap_over_keys_and_starts_is_a_loop_over_them():
    solver = ZeroGrads(0.3, **QUICK)
    one = lambda key, y0: run(plateaus, solver, y0, steps=20, key=key).value
    keys, starts = jax.random.split(KEY, 3), jnp.array([[0.0, 0.0], [1.0, 1.0], [-1.0, 0.5]])
    many = jax.jit(jax.vmap(one))(keys, starts)
    for key, y0, value in zip(keys, starts, many, strict=True):
        np.testing.assert_allclose(value, one(key, y0), rtol=1e-4, atol=1e-5)


def test_the_state_is_arrays_and_keeps_its_form():
    solver, y0, options = ZeroGrads(0.3), jnp.zeros(2), {"key": KEY}
    fn, state = started(lambda y, args: bowl(y, TARGET), solver, y0, options)
    step = jax.jit(lambda state: solver.step(fn, y0, None, options, state, frozenset()))
    y, after, _ = step(state)
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(state))
    assert eqx.tree_equal(*jax.eval_shape(lambda: (state, after)))
    assert (after.progress.step, after.progress.evaluations) == (1, 2)
    assert np.isnan(after.progress.stderr)
    assert not jnp.array_equal(y, y0)


def test_a_module_that_is_already_made_is_used_as_it_is():
    made = eqx.nn.MLP(2, "scalar", 8, 1, jnp.tanh, key=jax.random.key(9))
    solver = ZeroGrads(0.3, **{**QUICK, "surrogate": made})
    _, state = started(lambda y, args: bowl(y, TARGET), solver, jnp.zeros(2), {"key": KEY})
    arrays = eqx.filter(made, eqx.is_inexact_array)
    jax.tree.map(np.testing.assert_array_equal, state.fit.weights, arrays)
    assert run(bowl, solver, jnp.zeros(2)).stats["fun"] < 0.1


def test_each_key_makes_its_own_surrogate():
    weights = [
        started(bowl, ZeroGrads(0.3), jnp.zeros(2), {"key": jax.random.key(i)})[1].fit.weights
        for i in (0, 1)
    ]
    first, second = (jax.tree.leaves(w)[0] for w in weights)
    assert not jnp.array_equal(first, second)


def test_aux_is_that_of_a_sample():
    fun = lambda y, args: (bowl(y, args), {"y": y})
    solution = run(fun, ZeroGrads(0.1, **QUICK), jnp.zeros(2), has_aux=True)
    np.testing.assert_allclose(solution.aux["y"], TARGET, atol=0.5)


# when it stops


def test_converges_at_tolerance():
    solver = ZeroGrads(0.3, optimizer=optax.sgd(0.0), surrogate=SMALL, atol=1e-6)
    solution = run(bowl, solver, jnp.zeros(2))
    assert solution.result == SUCCESS
    assert solution.stats["num_steps"] == 5


def test_drop_leaves_failed_samples_out():
    fun = lambda y, args: jnp.where(jnp.cos(50 * y[0]) > 0.8, jnp.nan, bowl(y, TARGET))
    drop = ZeroGrads(0.3, **QUICK, num_samples=32, nonfinite="drop")
    solution = run(fun, drop, jnp.zeros(2), steps=200)
    assert solution.result == MAX_STEPS
    np.testing.assert_allclose(solution.value, TARGET, atol=0.2)
    propagate = ZeroGrads(0.3, **QUICK, num_samples=16)
    assert run(fun, propagate, jnp.zeros(2)).result == NONFINITE


def test_a_failed_step_keeps_everything_and_says_so():
    fun = lambda y, args: jnp.where(y[0] > 0.3, jnp.nan, bowl(y, TARGET))
    solution = run(fun, ZeroGrads(0.1, **QUICK), jnp.zeros(2))
    assert solution.result == NONFINITE
    assert all(jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(solution.state.fit))
    assert jnp.all(jnp.isfinite(solution.value))


# bad input


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"sigma": -1.0}, "positive"),
        ({"sigma": None}, "nothing is smoothed"),
        ({"sigma": [0.1]}, "structure"),
        ({"sigma": {"a": 0.1, "b": None}}, "sigma for every leaf"),
        ({"inner_sigma": -0.1}, "inner_sigma"),
        ({"inner_sigma": [0.1]}, "inner_sigma"),
        ({"num_samples": 7}, "multiple of 2"),
        ({"num_samples": 1, "sampler": sd.Gaussian()}, "up_to_constant=False"),
        ({"surrogate_steps": 0}, "surrogate_steps"),
        ({"parameter_steps": 0}, "parameter_steps"),
        ({"replay": -1}, "replay"),
        ({"local": False}, "bounds"),
        ({"sampler": sd.Uniform()}, "weights"),
    ],
    ids=names,
)
def test_bad_settings_are_refused(change, match):
    settings = {"sigma": 0.1, "surrogate": SMALL, **change}
    y0 = {"a": jnp.zeros(()), "b": jnp.zeros(())}
    with pytest.raises(ValueError, match=match):
        run(lambda y, args: y["a"] ** 2 + y["b"], ZeroGrads(**settings), y0)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"optimizer": optax.adam}, "optimizer"),
        ({"surrogate_optimizer": None}, "surrogate_optimizer"),
        ({"surrogate": "mlp"}, "surrogate"),
    ],
    ids=names,
)
def test_what_is_of_the_wrong_kind_is_refused(change: dict[str, Any], match):
    with pytest.raises(TypeError, match=match):
        ZeroGrads(0.1, **change)
