"""What to blame: which terms a parameter is credited with, and what that does to the estimates."""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
from closed_forms import assert_same, assert_unbiased, keys

import smoothdiff as sd

KEY = jax.random.key(0)
N = 6
THETA = jnp.array([0.1, -0.3, 0.2, 0.0, 0.4, -0.2])
SIGMA = 0.5
V = jnp.array([1.0, -1.0, 0.5, 2.0, 0.0, 1.0])


def terms(x):
    """Each term is a step in the sum of a parameter and its neighbours, with a height."""
    padded = jnp.pad(x, 1)
    total = padded[:-2] + padded[1:-1] + padded[2:]
    return jnp.arange(1.0, N + 1, dtype=x.dtype) * (total > 0).astype(x.dtype)


def smoothed_terms(x, sigma=SIGMA):
    """Phi of the sums over their standard deviation; the outermost have two parameters."""
    padded = jnp.pad(x, 1)
    total = padded[:-2] + padded[1:-1] + padded[2:]
    count = jnp.array([2.0, 3.0, 3.0, 3.0, 3.0, 2.0])
    height = jnp.arange(1.0, N + 1)
    return height * jax.scipy.stats.norm.cdf(total / (sigma * jnp.sqrt(count)))


def smoothed(x, sigma=SIGMA):
    return jnp.sum(smoothed_terms(x, sigma))


def matrix_of(support, shape):
    """The dense matrix of a linear map, terms by parameters."""
    jacobian = jax.jit(jax.jacfwd(support))(np.zeros(shape, np.float32))
    return np.asarray(jacobian).reshape(-1, int(np.prod(shape)))


SUPPORT = sd.local_support(1, ndim=1)


# ---------------------------------------------------------------------------------------------
# unbiased where it covers the truth


@pytest.mark.parametrize(
    ("sampler", "num_samples", "baseline"),
    [
        pytest.param(sd.Gaussian(), 16, "mean", marks=pytest.mark.slow),
        pytest.param(sd.Gaussian(), 16, "none", marks=pytest.mark.slow),
        pytest.param(sd.Gaussian(antithetic=True), 17, "center", marks=pytest.mark.slow),
        pytest.param(sd.Sobol(replicates=2), 16, "mean", marks=pytest.mark.slow),
        (sd.Orthogonal(), 24, "mean"),
    ],
    ids=["mean", "none", "center", "sobol", "frames"],
)
def test_every_derivative_is_unbiased(sampler, num_samples, baseline):
    """With a support that is right, or wider than it need be; the terms may hold zeros' blame."""
    options: dict[str, Any] = {
        "sampler": sampler,
        "num_samples": num_samples,
        "baseline": baseline,
        "support": sd.local_support(2, ndim=1) if baseline == "none" else SUPPORT,
    }

    def estimates(key):
        value = sd.smooth(terms, SIGMA, **options)(key, THETA)
        made = sd.smooth_quadratic(terms, SIGMA, **options)(key, THETA)
        return value, made.grad, made.hessian.as_matrix()

    @jax.jit
    def exact(x):
        return smoothed_terms(x), jax.grad(smoothed)(x), jax.hessian(smoothed)(x)

    found = jax.jit(jax.vmap(estimates))(keys(4096))
    assert_unbiased(found, exact(THETA), resolution=0.1)


def test_the_transforms_agree():
    """`smooth` returns the terms; the derivatives are those of their sum, but for the Jacobian."""
    options: dict[str, Any] = {
        "sampler": sd.Gaussian(),
        "num_samples": 16,
        "baseline": "mean",
        "support": SUPPORT,
    }

    @jax.jit
    def run(key, x):
        g = lambda x: sd.smooth(terms, SIGMA, **options)(key, x)
        made = sd.smooth_quadratic(terms, SIGMA, **options)(key, x)
        both = sd.smooth_value_and_grad(terms, SIGMA, **options)(key, x)
        found = {
            "value": both[0],
            "grad": both[1],
            "gradient": sd.smooth_grad(terms, SIGMA, **options)(key, x),
            "jacobian": sd.smooth_jacobian(terms, SIGMA, **options)(key, x),
            "hessian": sd.smooth_hessian(terms, SIGMA, **options)(key, x),
            "hvp": sd.smooth_hvp(terms, SIGMA, **options)(key, x, V),
            "model": (made.value, made.grad, made.hessian.as_matrix(), made.hessian.mv(V)),
        }
        total = lambda x: jnp.sum(g(x))
        value, grad, hessian = total(x), jax.grad(total)(x), jax.hessian(total)(x)
        product = jnp.matmul(hessian, V, precision="highest")
        want = {
            "value": value,
            "grad": grad,
            "gradient": grad,
            "jacobian": jax.jacrev(g)(x),
            "hessian": hessian,
            "hvp": product,
            "model": (value, grad, hessian, product),
        }
        return g(x), found, want

    value, found, want = run(KEY, THETA)
    assert value.shape == (N,)
    assert_same(found, want, scale=5)
    # a parameter has no derivative of a term that it is not credited with
    outside = matrix_of(SUPPORT, (N,)) == 0
    assert np.all(np.asarray(found["jacobian"])[outside] == 0)
    assert_same(np.sum(found["jacobian"], axis=0), found["grad"], scale=5)


def test_derivatives_in_sigma_are_unbiased():
    def estimate(key):
        g = lambda x, s: jnp.sum(
            sd.smooth(terms, s, num_samples=16, support=SUPPORT, baseline="mean")(key, x)
        )
        first = jax.grad(g, argnums=1)
        return first(THETA, SIGMA), jax.grad(first)(THETA, SIGMA), jax.grad(first, 1)(THETA, SIGMA)

    @jax.jit
    def exact(x, s):
        first = jax.grad(smoothed, argnums=1)
        return first(x, s), jax.grad(first)(x, s), jax.grad(first, 1)(x, s)

    found = jax.jit(jax.vmap(estimate))(keys(4096))
    assert_unbiased(found, exact(THETA, SIGMA), resolution=0.1)


def test_a_support_that_is_too_narrow_is_biased():
    """What is left out is lost: the expectation is the derivative along the support's own part."""
    narrow = sd.local_support(0, ndim=1)
    g = sd.smooth_grad(
        terms, SIGMA, support=narrow, num_samples=16, baseline="mean", sampler=sd.Gaussian()
    )
    found = jax.jit(jax.vmap(g, in_axes=(0, None)))(keys(4096), THETA)
    found, jacobian = np.asarray(found), np.asarray(jax.jit(jax.jacobian(smoothed_terms))(THETA))
    assert_unbiased(found, np.diagonal(jacobian), resolution=0.1)
    error = np.std(found, axis=0) / np.sqrt(4096)
    assert np.min(np.abs(np.mean(found, axis=0) - np.sum(jacobian, axis=0)) / error) > 10


def test_the_variance_falls_by_the_number_of_terms():
    """n independent steps at their edge, f_p = [x_p > 0].

    Var z_p (f_p - 1/2) = 1/4 - 1/(2 pi); each other term adds Var f = 1/4 if it is blamed too.
    The mean of the N - 1 others has a noise of its own.
    """
    n, num = 64, 32
    steps = lambda x: (x > 0).astype(x.dtype)
    options: dict[str, Any] = {"sampler": sd.Gaussian(), "num_samples": num, "baseline": "mean"}
    local = sd.smooth_grad(steps, 1.0, support=sd.local_support(0, ndim=1), **options)
    scalar = sd.smooth_grad(lambda x: jnp.sum(steps(x)), 1.0, **options)
    run = lambda g: np.mean(np.var(jax.jit(jax.vmap(g, (0, None)))(keys(1000), jnp.zeros(n)), 0))
    own = 1 / 4 - 1 / (2 * np.pi) + (1 / 4 + 1 / (2 * np.pi)) / (num - 1)
    others = (n - 1) / 4 * (1 + 1 / (num - 1))
    assert others / own > 150
    np.testing.assert_allclose(run(local), own / num, rtol=0.03)
    np.testing.assert_allclose(run(scalar), (own + others) / num, rtol=0.05)


def test_standard_errors_are_the_spread():
    options: dict[str, Any] = {"sampler": sd.Gaussian(), "num_samples": 64, "support": SUPPORT}

    def run(key):
        made = sd.smooth_quadratic(terms, SIGMA, baseline="mean", **options)(key, THETA)
        jacobian = sd.smooth_jacobian(terms, SIGMA, baseline="mean", stderr=True, **options)
        value, error = made.stderr
        estimate, spread = jacobian(key, THETA)
        found = made.value, made.grad, made.hessian.mv(V), estimate
        return found, (value, error, made.hessian_stderr(V), spread)

    found, errors = jax.jit(jax.vmap(run))(keys(1000))
    for estimate, error in zip(found, errors, strict=True):
        spread = np.std(np.asarray(estimate, float), axis=0)
        mean = np.sqrt(np.mean(np.asarray(error, float) ** 2, axis=0))
        np.testing.assert_allclose(mean, spread, rtol=0.12, atol=1e-6)


@pytest.mark.parametrize("batch_size", [5, 16])
def test_chunks_and_dropped_samples(batch_size, x64):
    bad = lambda x: jnp.where(x[0] > 0.9, jnp.nan, terms(x))
    options: dict[str, Any] = {"num_samples": 32, "support": SUPPORT, "nonfinite": "drop"}
    x, v = THETA.astype(float), V.astype(float)
    g = lambda size: sd.smooth_quadratic(bad, SIGMA, batch_size=size, baseline="mean", **options)
    model = lambda size: (lambda m: (m.value, m.grad, m.hessian.mv(v)))(g(size)(KEY, x))
    whole, parts = jax.jit(lambda: (model(None), model(batch_size)))()
    assert_same(parts, whole, np.float64)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(whole))


def test_parameters_may_be_a_pytree():
    """A matrix over the raveled parameters; each leaf has its own width."""
    both = lambda p: terms(jnp.concatenate([p["a"], p["b"].reshape(-1)]))
    p = {"a": THETA[:2], "b": THETA[2:].reshape(2, 2)}
    support = sd.matrix_support(matrix_of(SUPPORT, (N,)))
    options: dict[str, Any] = {"num_samples": 16, "sampler": sd.Gaussian(), "baseline": "mean"}

    @jax.jit
    def run():
        tree = sd.smooth_grad(both, {"a": SIGMA, "b": SIGMA}, support=support, **options)(KEY, p)
        return tree, sd.smooth_grad(terms, SIGMA, support=SUPPORT, **options)(KEY, THETA)

    tree, flat = run()
    assert_same(np.concatenate([tree["a"], np.ravel(tree["b"])]), flat)


# ---------------------------------------------------------------------------------------------
# the helpers


@pytest.mark.parametrize(
    ("shape", "ndim", "radius"),
    [
        ((7,), 1, 2),
        ((5, 3), 1, 1),
        ((4, 5), 2, 1),
        ((4, 3, 2), 2, 1),
        ((3, 4, 2), 3, 1),
        ((4,), 1, 9),
    ],
)
def test_local_support_is_its_matrix(shape, ndim, radius):
    """By the definition: one where cells are at most the radius apart along every axis."""
    space, channels = shape[:ndim], int(np.prod(shape[ndim:]))
    cells = list(itertools.product(*map(range, space)))
    want = [
        [float(max(abs(a - b) for a, b in zip(p, j, strict=True)) <= radius) for j in cells]
        for p in cells
    ]
    support = sd.local_support(radius, ndim=ndim)
    found = matrix_of(support, shape)
    np.testing.assert_array_equal(found, np.repeat(want, channels, axis=1))
    # AD supplies the transpose
    zeros = np.zeros(shape, np.float32)
    assert jax.eval_shape(support, zeros).shape == space
    cotangent = jax.random.normal(KEY, space)
    transposed = jax.jit(lambda c: jax.vjp(support, zeros)[1](c)[0])(cotangent)
    want_transposed = found.T @ np.ravel(cotangent)
    np.testing.assert_allclose(np.ravel(transposed), want_transposed, rtol=1e-5, atol=1e-5)


def test_local_support_holds_no_matrix():
    support = sd.local_support(2)
    jaxpr = jax.make_jaxpr(support)(jnp.zeros((64, 64)))
    sizes = [v.aval.size for eqn in jaxpr.jaxpr.eqns for v in eqn.outvars]
    assert max(sizes) <= 64 * 64


@pytest.mark.parametrize("make", [np.asarray, scipy.sparse.csr_matrix, scipy.sparse.coo_array])
def test_matrix_support_is_the_matrix(make):
    dense = np.random.default_rng(0).random((6, 4)) < 0.4
    support = sd.matrix_support(make(dense * 2.5))
    np.testing.assert_array_equal(matrix_of(support, (4,)), dense)
    shaped = sd.matrix_support(make(dense * 2.5), (2, 3))
    assert jax.eval_shape(shaped, np.zeros(4, np.float32)).shape == (2, 3)
    np.testing.assert_array_equal(matrix_of(shaped, (4,)), dense)
    with pytest.raises(ValueError, match=r"6 rows.*\(2, 2\)"):
        sd.matrix_support(make(dense), (2, 2))


def test_all_kinds_of_support_give_the_same():
    dense = matrix_of(SUPPORT, (N,))
    kinds = {
        "local": SUPPORT,
        "matrix": sd.matrix_support(scipy.sparse.csr_matrix(dense)),
        "function": lambda x: jnp.matmul(jnp.asarray(dense, x.dtype), x, precision="highest"),
    }
    options: dict[str, Any] = {"num_samples": 16, "sampler": sd.Gaussian(), "baseline": "mean"}
    gradient = lambda s: sd.smooth_grad(terms, SIGMA, support=s, **options)(KEY, THETA)
    found = jax.jit(lambda: {name: gradient(s) for name, s in kinds.items()})()
    assert_same(found["matrix"], found["local"])
    assert_same(found["function"], found["local"])


def test_a_full_support_is_none_at_all():
    """Every parameter blamed for every term: the estimate of the sum."""
    options: dict[str, Any] = {"num_samples": 16, "sampler": sd.Gaussian(), "baseline": "mean"}

    @jax.jit
    def run():
        full = sd.matrix_support(np.ones((N, N)))
        total = lambda x: jnp.sum(terms(x))
        with_it = sd.smooth_hessian(terms, SIGMA, support=full, **options)(KEY, THETA)
        return with_it, sd.smooth_hessian(total, SIGMA, **options)(KEY, THETA)

    assert_same(*run(), scale=10)


def test_a_support_that_moves_is_asked_where_the_parameters_are():
    """Left of zero a parameter has its own term, right of it the neighbours' too."""

    def around(x):
        left = (x < 0).astype(x.dtype)
        return lambda p: jnp.eye(N) @ (left * p) + SUPPORT((1 - left) * p)

    left = (THETA < 0).astype(THETA.dtype)
    matrix = np.where(np.asarray(left) > 0, np.eye(N), matrix_of(SUPPORT, (N,)))

    @jax.jit
    def run():
        make = lambda support: sd.smooth_hvp(terms, SIGMA, num_samples=64, support=support)
        options: dict[str, Any] = {"num_samples": 64, "sampler": sd.Gaussian(), "baseline": "mean"}
        moving = sd.moving_support(around)
        gradient = [
            sd.smooth_grad(terms, SIGMA, support=s, **options)(KEY, THETA)
            for s in (moving, around(THETA), sd.matrix_support(matrix))
        ]
        product = [make(s)(KEY, THETA, V) for s in (moving, around(THETA))]
        return gradient, product

    (moving, still, known), product = run()
    assert_same(moving, still)
    assert_same(moving, known)
    assert_same(*product)


def test_a_moving_support_alone_is_nowhere():
    with pytest.raises(ValueError, match=r"support\.at"):
        sd.moving_support(lambda x: lambda p: p)(THETA)


# ---------------------------------------------------------------------------------------------
# bad input


def grad(fun=terms, **options):
    options = {"support": SUPPORT, "num_samples": 8, "baseline": "mean", **options}
    return lambda: sd.smooth_grad(fun, SIGMA, **options)(KEY, THETA)


BAD = {
    "gp": (grad(baseline="gp"), ValueError, '"mean", "center" or "none"'),
    "linear": (grad(baseline="linear"), ValueError, '"mean", "center" or "none"'),
    "the sum itself": (grad(lambda x: jnp.sum(terms(x))), ValueError, "not the sum itself"),
    "other terms": (grad(lambda x: terms(x)[:3]), ValueError, r"shape \(6,\).*\(3,\)"),
    "two arrays": (grad(lambda x: (terms(x), terms(x))), ValueError, "one array of terms"),
    "weighted points": (grad(sampler=sd.Aggregate(1)), ValueError, "normal themselves"),
    "no function": (grad(support=np.eye(N)), TypeError, "support"),
    "parameters with fewer axes": (grad(support=sd.local_support(1)), ValueError, "2 axes"),
}


@pytest.mark.parametrize(("call", "error", "message"), BAD.values(), ids=BAD)
def test_support_that_cannot_be(call, error, message):
    with pytest.raises(error, match=message):
        call()


def test_a_leaf_that_is_not_smoothed_has_no_support():
    g = sd.smooth_grad(
        lambda p: terms(p["a"]) * p["b"],
        {"a": SIGMA, "b": None},
        support=lambda p: SUPPORT(p["a"]),
        baseline="mean",
    )
    with pytest.raises(ValueError, match="sigma for every leaf"):
        g(KEY, {"a": THETA, "b": jnp.array(1.0)})


def test_helpers_with_numbers_out_of_range():
    with pytest.raises(ValueError, match="radius"):
        sd.local_support(-1)
    with pytest.raises(ValueError, match="ndim"):
        sd.local_support(1, ndim=0)
    with pytest.raises(TypeError, match="around"):
        sd.moving_support(SUPPORT(THETA))  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("matrix", [np.eye(4, 3), np.roll(np.eye(5), 1, axis=0)[:4]])
def test_a_matrix_has_a_column_for_each_parameter(matrix):
    terms = lambda x: (jnp.round(4 * x) - 4) ** 2
    for columns in (matrix, scipy.sparse.csr_matrix(matrix), matrix.tolist()):
        grad = sd.smooth_grad(terms, 0.5, support=sd.matrix_support(columns))
        with pytest.raises(ValueError, match="columns for 4 smoothed parameters"):
            grad(jax.random.key(0), jnp.zeros(4))


def test_a_moving_support_is_a_function():
    support = sd.moving_support(lambda y: jnp.eye(4))  # pyright: ignore[reportArgumentType]
    grad = sd.smooth_grad(lambda y: y**2, 0.5, support=support)
    with pytest.raises(TypeError, match=r"such as sd\.matrix_support"):
        grad(jax.random.key(0), jnp.zeros(4))
