"""ZeroGrads: its estimator against quadrature, what it converges to, accepts and refuses."""

import functools
import itertools
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


def run(fun, solver, y0, args: Any = TARGET, *, bounds=None, steps=300, key=KEY, **rest):
    options = {"key": key} if bounds is None else {"key": key, "bounds": bounds}
    return optx.minimise(fun, solver, y0, args, options, max_steps=steps, throw=False, **rest)


def scaled(y, args):
    target, scale, offset = args
    return offset + scale * bowl(y, target)


def cliff(y, args):
    return jnp.where(y[0] > 0.3, jnp.nan, scaled(y, args))


def holes(y, args):
    """A tenth of all points."""
    return jnp.where(jnp.cos(50 * y[0]) > 0.95, jnp.nan, scaled(y, args))


PROBLEMS = [lambda y, args: plateaus(y, args[0]), scaled, cliff, holes]
PLATEAUS, BOWL, CLIFF, HOLES = range(len(PROBLEMS))


ORIGIN = np.zeros(2, np.float32)


def any_run(solver):
    """A compiled run on any of the problems, since which of them is data."""

    @jax.jit
    def run_(which, y0, scale, offset, key):
        fun = lambda y, args: jax.lax.switch(which, PROBLEMS, y, args)
        args: Any = TARGET.astype(y0.dtype), scale.astype(y0.dtype), offset.astype(y0.dtype)
        return run(fun, solver, y0, args, key=key)

    return lambda which, y0=ORIGIN, scale=1.0, offset=0.0, key=KEY: run_(
        jnp.asarray(which, jnp.int32), jnp.asarray(y0), jnp.asarray(scale), jnp.asarray(offset), key
    )


quick = any_run(ZeroGrads(0.3, **QUICK))


def height(y):
    """The bowl at a point, in NumPy."""
    return np.sum((np.asarray(y) - np.asarray(TARGET)) ** 2)


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


SURROGATES = {"1-D": SMALL, "2-D": SMALL, "2-D quadratic": Quadratic}
WAYS = ["pairs", "sobol", "up to a constant"]
QUICK_PAIRS = [("1-D", "pairs")]


@pytest.mark.parametrize(
    ("place", "how"),
    [
        pytest.param(*pair, marks=[] if pair in QUICK_PAIRS else pytest.mark.slow)
        for pair in itertools.product(SURROGATES, WAYS)
    ],
)
def test_the_gradient_of_the_surrogate_is_unbiased(place, how, x64):
    surrogate = SURROGATES[place]
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
    exact = jax.jit(lambda w: jax.grad(quadrature_loss)(w, rest, place, up_to_constant))(weights)
    # N independent errors vary by (N - 1)/N of their variance around their own mean
    exact = ravel_pytree(exact)[0] * ((num - 1) / num if up_to_constant else 1)
    stderr = np.std(estimates, axis=0) / np.sqrt(len(estimates))
    off = np.abs(np.mean(estimates, axis=0) - exact)
    assert np.all(off < 4.5 * stderr + 1e-7)
    # and the tolerance means something
    assert np.linalg.norm(stderr) < 0.05 * np.linalg.norm(exact)


def test_pairs_mirror_both_kernels_together():
    solver = ZeroGrads(SIGMA, inner_sigma=INNER, num_samples=6)
    fn = lambda y: (bowl(y, TARGET), None)
    params = take_apart(jnp.asarray(THETA, jnp.float32), SIGMA, None)
    locality = solver._locality(params, params.theta, jnp.asarray(0), {"key": KEY})
    rho = np.asarray(jax.jit(lambda: locality.around(fn)[0])())
    middle = (rho[0::2] + rho[1::2]) / 2
    np.testing.assert_allclose(middle, np.tile(params.theta, (3, 1)), atol=1e-6)


def test_replayed_samples_stand_for_the_present_neighbourhood():
    """Weighted by the ratio of densities they have its moments; a weight is at most a share."""
    num = 20_000

    @jax.jit
    def replayed():
        old, new, width = (jnp.array([v]) for v in (0.3, 0.0, 1.0))
        u = old[None] + 2 * jax.random.normal(KEY, (num, 1))
        away = lambda u, center, width: -(((u - center) / width) ** 2).sum() / 2
        density = lambda u, center, width: away(u, center, width) - jnp.log(width)[0]
        drawn = jax.vmap(lambda u: density(u, old, 2 * width))(u)
        replay = Replay.start(2, num, old, jnp.float32).after(
            jnp.asarray(0), u, u[:, 0], jnp.full(num, 1 / num), drawn
        )
        now = jax.vmap(jax.vmap(lambda u: density(u, new, width)))(replay.u)
        # no cap is met where the present density is lower than the other by a factor
        return u[:, 0], drawn, now[0], replay.weights(now - 5), replay.weights(now)

    u, drawn, now, weights, capped = map(np.asarray, replayed())
    np.testing.assert_allclose(np.sum(weights), 1, rtol=1e-5)
    np.testing.assert_array_equal(weights[1], 0)
    np.testing.assert_allclose(np.sum(weights[0] * u), 0, atol=0.05)
    np.testing.assert_allclose(np.sum(weights[0] * u**2), 1, atol=0.1)
    assert np.max(capped) <= 1.01 * np.min(capped[0][drawn <= now])


def test_the_newest_batch_has_its_shares_and_the_oldest_goes():
    @jax.jit
    def replayed():
        u, share = jnp.ones((2, 3)), jnp.full(2, 0.5)
        replay = Replay.start(2, 2, u[0], jnp.float32)
        for step in range(3):
            values = jnp.full(2, float(step))
            replay = replay.after(jnp.asarray(step), u * step, values, share, jnp.zeros(2))
        near, far = jnp.zeros((2, 2)), jnp.array([[0.0, 0.0], [-1e4, -1e4]])
        return replay.values[:, 0], replay.weights(near), replay.weights(far)

    values, near, far = replayed()
    np.testing.assert_array_equal(values, [2, 1])
    np.testing.assert_allclose(near, np.full((2, 2), 0.25))
    np.testing.assert_allclose(far, [[0.5, 0.5], [0, 0]])


# what it finds


def test_crosses_plateaus_in_both_precisions(dtype):
    solution = quick(PLATEAUS, np.zeros(2, dtype))
    assert solution.value.dtype == solution.stats["fun"].dtype == dtype
    np.testing.assert_allclose(solution.value, TARGET, atol=0.1)
    assert solution.result == MAX_STEPS
    assert solution.stats["evaluations"] == 300 * 2 + 4 + 2
    weights = jax.tree.leaves(solution.state.fit.weights)
    assert all(w.dtype == dtype for w in weights)


CHANGES: list[dict[str, Any]] = [
    {"inner_sigma": 0.0},
    {"surrogate": Quadratic},
    {"up_to_constant": False},
    {"sampler": sd.Sobol(), "num_samples": 16},
    {"log": True},
    {"nonfinite": "drop"},
    {"surrogate_steps": 1, "parameter_steps": 2},
    {"replay": 0, "up_to_constant": True},
    # a line search, on the surrogate
    {"optimizer": optax.chain(optax.sgd(0.05), optax.scale_by_backtracking_linesearch(5))},
]
# each of them in one of these
TOGETHER = [functools.reduce(dict.__or__, CHANGES[i : i + 3]) for i in (0, 3, 6)]
CONFIGURED = [any_run(ZeroGrads(0.3, **QUICK | change)) for change in TOGETHER + CHANGES]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "runs"),
    [
        pytest.param(*both, marks=[] if both[0] in TOGETHER else pytest.mark.slow)
        for both in zip(TOGETHER + CHANGES, CONFIGURED, strict=True)
    ],
    ids=map(names, TOGETHER + CHANGES),
)
def test_every_configuration_descends(change, runs):
    solution = runs(BOWL)
    assert height(solution.value) < 0.1 * height(np.zeros(2))
    # what is done on the surrogate costs nothing
    assert solution.stats["evaluations"] == 4 + 301 * change.get("num_samples", 2)


def test_drop_leaves_failed_samples_out():
    solution = CONFIGURED[1](HOLES)
    assert solution.result == MAX_STEPS
    np.testing.assert_allclose(solution.value, TARGET, atol=0.2)
    assert quick(HOLES).result == NONFINITE


@pytest.mark.parametrize("nonfinite", ["propagate", "drop"])
def test_the_logarithm_of_a_negative_function_is_named(nonfinite):
    solver = ZeroGrads(0.3, log=True, nonfinite=nonfinite)
    with pytest.raises(sd.MinimiseError, match="log=True is for functions that are never negative"):
        sd.minimise(lambda y, args: bowl(y, args) - 5, TARGET, TARGET, key=KEY, solver=solver)


def test_without_locality_it_samples_all_that_is_within_the_bounds():
    low, high = jnp.array([-1.0, 2.0]), jnp.array([1.0, 6.0])
    solver = ZeroGrads(0.1, local=False, num_samples=2000)
    y, bounds = jnp.array([0.5, 3.0]), (low, high)
    params = take_apart(y, 0.1, bounds)
    fn = lambda y: (bowl(y, TARGET), None)
    options = {"key": KEY, "bounds": bounds}
    locality = solver._locality(params, y, jnp.asarray(0), options)
    rho = np.asarray(jax.jit(lambda: locality.around(fn)[0])())
    low, high = np.asarray(low), np.asarray(high)
    assert np.all((low < rho) & (rho < high))
    share = (rho - low) / (high - low)
    np.testing.assert_allclose(np.mean(share, axis=0), 0.5, atol=1e-6)
    # 4 standard errors of the second moment of a uniform number, 1/12, whose fourth is 1/80
    spread = 4 * np.sqrt((1 / 80 - 1 / 144) / 1000)
    np.testing.assert_allclose(np.mean((share - 0.5) ** 2, axis=0), 1 / 12, atol=spread)


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_the_run_does_not_depend_on_the_scale_of_the_function(scale):
    plain, other = (quick(BOWL, scale=s).value for s in (1.0, scale))
    np.testing.assert_allclose(other, plain, atol=1e-3)


def test_a_large_offset_leaves_only_its_own_rounding():
    solution = quick(BOWL, scale=8.0, offset=1e4)
    np.testing.assert_allclose(solution.value, TARGET, atol=0.15)


@pytest.mark.slow
def test_sigma_and_its_units_scale_the_run():
    """The surrogate sees units of sigma: other units give the same run."""

    @jax.jit
    @jax.vmap
    def final(unit):
        solver = ZeroGrads({"a": 0.3, "b": 0.3 * unit}, surrogate=SMALL, replay=5)
        fun = lambda y, t: bowl(jnp.stack([y["a"], y["b"] / unit]), t)
        return run(fun, solver, {"a": jnp.float32(0.0), "b": jnp.float32(0.0)}, steps=40).value

    found = final(jnp.array([1.0, 100.0]))
    np.testing.assert_allclose(found["a"][1], found["a"][0], rtol=1e-3)
    np.testing.assert_allclose(found["b"][1], 100 * found["b"][0], rtol=1e-3)
    # and it is one that goes somewhere
    assert found["a"][0] > 0.1


BOXED = ZeroGrads(optax.linear_schedule(0.3, 0.1, 30), **{**QUICK, "optimizer": optax.adam(0.05)})
LOW, HIGH = -0.3, {"a": 0.5, "b": [np.array([0.1])]}
SEEN = []


def host(y):
    SEEN.append(np.array(y))
    return np.float32(stairs(y, np.asarray(TARGET)))


def stairs(y, target):
    """A bowl in two numbers and steps in one; each minimum but one is out of bounds."""
    return ((y[:2] - target) ** 2).sum() + (4 * abs(y[2] - 0.25)) // 1


def boxed(y, args):
    """In float32 it is a black box."""
    y = jnp.append(y["a"], y["b"][0])
    if y.dtype == jnp.float64:
        return stairs(y, TARGET.astype(y.dtype))
    return sd.black_box(host, jax.ShapeDtypeStruct((), y.dtype))(y)


def start(dtype):
    return {"a": np.zeros(2, dtype), "b": [np.zeros(1, dtype)]}


@pytest.mark.slow
def test_bounds_hold_for_the_iterates_and_for_what_the_function_sees():
    SEEN.clear()
    result = sd.minimise(
        boxed, start(np.float32), key=KEY, solver=BOXED, max_steps=60, bounds=(LOW, HIGH)
    )
    np.testing.assert_allclose(result.y["a"], [0.5, -0.3], atol=0.05)
    points = np.stack(SEEN)
    assert len(points) == result.evaluations
    low, high = np.float32(-0.3), np.array([0.5, 0.5, 0.1], np.float32)
    assert np.all((points >= low) & (points <= high))
    # or the test would show nothing
    assert np.all(np.min(points, axis=0) == low)
    assert np.all(np.max(points, axis=0) == high)
    for record in result.history:
        y = np.append(record.y["a"], record.y["b"][0])
        assert np.all((y >= low) & (y <= high))


# how it runs


@pytest.mark.parametrize(
    ("dtype", "to_the_last_bit"),
    [
        ("float32", False),
        # as users compile them
        pytest.param("float32", True, marks=pytest.mark.slow),
        pytest.param("float64", True, marks=pytest.mark.slow),
    ],
    indirect=["dtype"],
)
def test_iterates_are_those_of_minimise(dtype, to_the_last_bit, tmp_path):
    bounds = LOW, HIGH
    y0 = start(dtype)
    solution = run(boxed, BOXED, y0, None, bounds=bounds, steps=30)
    go = functools.partial(sd.minimise, boxed, y0, key=KEY, solver=BOXED, bounds=bounds)
    result = go(max_steps=30)
    same = functools.partial(np.testing.assert_allclose, rtol=0 if to_the_last_bit else 1e-4)
    jax.tree.map(same, result.y, solution.value)
    same(result.fun, solution.stats["fun"])
    same(result.smoothed, solution.stats["smoothed"])
    assert result.evaluations == solution.stats["evaluations"] == 30 * 2 + 4 + 2
    first = result.history[0]
    assert (first.step, first.evaluations) == (1, 2)
    assert np.isnan(first.stderr)
    # a run that is taken up again ends with the same bits
    path = tmp_path / "run.npz"
    go(max_steps=12, checkpoint=path)
    again = go(max_steps=30, checkpoint=path)
    jax.tree.map(np.testing.assert_array_equal, again.y, result.y)
    assert again.fun == result.fun
    assert len(again.history) == 30


@pytest.mark.slow
def test_vmap_over_keys_and_starts_is_a_loop_over_them(x64):
    keys, starts = jax.random.split(KEY, 3), jnp.array([[0.0, 0.0], [1.0, 1.0], [-1.0, 0.5]])
    one = lambda key, y0: quick(BOWL, y0, key=key).value
    many = jax.jit(jax.vmap(one))(keys, starts)
    for key, y0, value in zip(keys, starts, many, strict=True):
        np.testing.assert_allclose(value, one(key, y0), rtol=1e-6)


def test_the_state_is_arrays_and_keeps_its_form():
    solver, y0, options = ZeroGrads(0.3, **QUICK), jnp.zeros(2), {"key": KEY}
    fn, state = started(lambda y, args: bowl(y, TARGET), solver, y0, options)
    step = lambda state: solver.step(fn, y0, None, options, state, frozenset())
    y, after, _ = jax.eval_shape(step, state)
    assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(state))
    assert eqx.tree_equal(after, jax.eval_shape(lambda: state))
    assert (y.shape, y.dtype) == (y0.shape, y0.dtype)


def test_a_module_that_is_already_made_is_used_as_it_is():
    """And a run converges at its tolerance, and its aux is that of a sample."""
    made = eqx.nn.MLP(2, "scalar", 8, 1, jnp.tanh, key=jax.random.key(9))
    slower = optax.adam(optax.linear_schedule(0.01, 0.0, 250))
    solver = ZeroGrads(0.3, **{**QUICK, "surrogate": made, "optimizer": slower}, atol=1e-3)
    _, state = started(lambda y, args: bowl(y, TARGET), solver, jnp.zeros(2), {"key": KEY})
    arrays = eqx.filter(made, eqx.is_inexact_array)
    jax.tree.map(np.testing.assert_array_equal, state.fit.weights, arrays)
    fun = lambda y, args: (bowl(y, args), {"y": y})
    solution = run(fun, solver, jnp.zeros(2), has_aux=True)
    assert solution.stats["fun"] < 0.1
    assert solution.result == SUCCESS
    assert 20 < solution.stats["num_steps"] < 250
    assert solution.state.stall == 5
    # of the last step: sigma is 0.3
    np.testing.assert_allclose(solution.aux["y"], TARGET, atol=1.2)


def test_each_key_makes_its_own_surrogate():
    make = lambda key: started(bowl, ZeroGrads(0.3), jnp.zeros(2), {"key": key})[1].fit.weights
    first = jax.tree.leaves(jax.jit(jax.vmap(make))(jax.random.split(KEY)))[0]
    assert not np.array_equal(first[0], first[1])


# when it stops


def test_a_failed_step_keeps_everything_and_says_so():
    solution = quick(CLIFF)
    assert solution.result == NONFINITE
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(solution.state.fit))
    assert np.all(np.isfinite(solution.value))


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


def test_points_anywhere_need_finite_bounds(key):
    for bounds, match in ((None, "give bounds"), ((0.0, jnp.inf), "give finite bounds")):
        with pytest.raises(ValueError, match=match):
            sd.minimise(
                lambda y, _: jnp.sum(y**2),
                jnp.ones(2),
                key=key,
                solver=ZeroGrads(0.3, local=False),
                bounds=bounds,
            )
